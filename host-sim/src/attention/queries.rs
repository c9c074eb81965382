//! Which tokens are asked where they look.
//!
//! The paper asks the middle of both maps, where the road is: rows 2, 3 and 4 of the 8×8 image tokens, and of the LiDAR
//! tokens rows 4, 5 and 6 of the map seen from above, with forward up. A LiDAR row is a column of the histogram, whose
//! rows are lateral: with the image's 64 tokens in front, row `iy` has the tokens `64 + 8·ix + iy`.

use super::block::{Grid, Grids};
use model_compiler::error::{Error, ErrorCode, Result};
use schemars::JsonSchema;
use serde::Serialize;

/// The paper's part of the image from above: rows 2..5 of 8.
const IMAGE_PART: [f64; 2] = [2.0 / 8.0, 5.0 / 8.0];
/// The paper's part of the LiDAR map from far to near: rows 4..7 of 8.
const LIDAR_PART: [f64; 2] = [4.0 / 8.0, 7.0 / 8.0];
/// The paper's number of strongest keys.
const TOP: u16 = 5;

/// Rows that somebody chose; else the rows of any grid whose centers lie in the paper's part of the map.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct QueryRows {
    /// Rows of the image tokens, from above.
    pub image: Option<Vec<u16>>,
    /// Rows of the LiDAR tokens, from far to near.
    pub lidar: Option<Vec<u16>>,
}

/// The tokens that are asked.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct Queries {
    /// Of the camera image.
    pub image: SensorQueries,
    /// Of the LiDAR histogram.
    pub lidar: SensorQueries,
}

/// The tokens of one sensor.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct SensorQueries {
    /// Rows and columns of its token map; of the LiDAR lateral cells from right to left and longitudinal cells from far
    /// to near.
    pub grid: [u16; 2],
    /// First token of the sensor.
    pub first_token: u16,
    /// Rows that are asked, as one sees them: of the image from above, of the LiDAR from far to near.
    pub rows: Vec<u16>,
    /// Their tokens.
    pub tokens: Vec<u16>,
}

impl Queries {
    /// The tokens of the chosen rows.
    ///
    /// # Errors
    /// A row is not in its grid.
    pub fn new(rows: &QueryRows, grids: Grids) -> Result<Self> {
        let Grids { image, lidar } = grids;
        let first = image.tokens();
        let image_rows = chosen("--image-rows", rows.image.as_deref(), image.rows, IMAGE_PART)?;
        let lidar_rows = chosen("--lidar-rows", rows.lidar.as_deref(), lidar.columns, LIDAR_PART)?;
        let along = |&row: &u16| (0..image.columns).map(move |column| image.columns * row + column);
        let across = |&column: &u16| (0..lidar.rows).map(move |row| first + lidar.columns * row + column);
        Ok(Self {
            image: SensorQueries::new(image, 0, image_rows.iter().flat_map(along).collect(), image_rows),
            lidar: SensorQueries::new(lidar, first, lidar_rows.iter().flat_map(across).collect(), lidar_rows),
        })
    }

    /// All tokens that are asked: those of the image, then those of the LiDAR.
    pub fn tokens(&self) -> impl Iterator<Item = u16> {
        self.image.tokens.iter().chain(&self.lidar.tokens).copied()
    }

    /// Whether a token is one of the LiDAR.
    pub fn is_lidar(&self, token: u16) -> bool {
        token >= self.lidar.first_token
    }
}

impl SensorQueries {
    fn new(Grid { rows, columns }: Grid, first_token: u16, tokens: Vec<u16>, chosen: Vec<u16>) -> Self {
        Self { grid: [rows, columns], first_token, rows: chosen, tokens }
    }
}

/// The number of strongest keys to take: the one asked for, else the paper's, or as many as a sensor has tokens.
///
/// # Errors
/// A sensor has fewer tokens, so that they could never all lie in it.
pub fn top(asked: Option<u16>, grids: Grids) -> Result<u16> {
    let most = grids.image.tokens().min(grids.lidar.tokens());
    match asked {
        None => Ok(TOP.min(most)),
        Some(top) if (1..=most).contains(&top) => Ok(top),
        Some(top) => {
            let message = format!("found {top}, expected 1 to {most}, the tokens of the sensor with the fewest");
            let error = Error::new(ErrorCode::Usage, "--top", message);
            Err(error.with_help(format!("leave it out for the {} strongest", TOP.min(most))))
        }
    }
}

fn chosen(option: &str, rows: Option<&[u16]>, count: u16, [from, to]: [f64; 2]) -> Result<Vec<u16>> {
    let Some(rows) = rows else {
        let center = |row: u16| (f64::from(row) + 0.5) / f64::from(count);
        return Ok((0..count).filter(|&row| from <= center(row) && center(row) < to).collect());
    };
    let mut sorted = rows.to_vec();
    sorted.sort_unstable();
    sorted.dedup();
    match sorted.last() {
        Some(&last) if last < count => Ok(sorted),
        _ => {
            let message = format!("found {rows:?}, expected rows 0 to {} of the token map", count.saturating_sub(1));
            let error = Error::new(ErrorCode::Usage, option, message);
            Err(error.with_help("leave it out for the rows of the paper"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grids(rows: u16, columns: u16) -> Grids {
        let grid = Grid { rows, columns };
        Grids { image: grid, lidar: grid }
    }

    #[test]
    fn the_paper_asks_24_tokens_of_each_sensor() {
        let queries = Queries::new(&QueryRows::default(), grids(8, 8)).unwrap();
        assert_eq!(queries.image.tokens, (16..40).collect::<Vec<_>>());
        let lidar: Vec<u16> = [4, 5, 6].iter().flat_map(|iy| (0..8).map(move |ix| 64 + 8 * ix + iy)).collect();
        assert_eq!((queries.lidar.tokens.len(), &queries.lidar.tokens), (24, &lidar));
        assert_eq!((&*queries.image.rows, &*queries.lidar.rows), (&[2, 3, 4][..], &[4, 5, 6][..]));
        assert!(queries.is_lidar(64) && !queries.is_lidar(63));
    }

    #[test]
    fn other_grids_have_the_same_part_of_the_map() {
        let rows = |rows, columns| {
            let queries = Queries::new(&QueryRows::default(), grids(rows, columns)).unwrap();
            (queries.image.rows, queries.lidar.rows)
        };
        assert_eq!(rows(2, 2), (vec![0], vec![1]));
        assert_eq!(rows(5, 22), (vec![1, 2], vec![11, 12, 13, 14, 15, 16, 17, 18]));
        for size in 1..40 {
            let (image, lidar) = rows(size, size);
            assert!(!image.is_empty() && !lidar.is_empty(), "{size}");
        }
        let queries = Queries::new(&QueryRows::default(), grids(2, 3)).unwrap();
        assert_eq!((queries.image.tokens, queries.lidar.tokens), (vec![0, 1, 2], vec![7, 10, 8, 11]));
    }

    #[test]
    fn rows_can_be_chosen_within_the_grid() {
        let choice = QueryRows { image: Some(vec![3, 0, 3]), lidar: Some(vec![1]) };
        let queries = Queries::new(&choice, grids(4, 2)).unwrap();
        assert_eq!(queries.image.tokens, [0, 1, 6, 7]);
        assert_eq!(queries.lidar.tokens, [9, 11, 13, 15]);
        let wrong = QueryRows { lidar: Some(vec![2]), ..choice };
        let error = Queries::new(&wrong, grids(4, 2)).unwrap_err();
        assert_eq!(error.location, "--lidar-rows");
        assert_eq!(error.message, "found [2], expected rows 0 to 1 of the token map");
        assert_eq!(error.help, "leave it out for the rows of the paper");
        let none = QueryRows { image: Some(vec![]), lidar: None };
        assert!(Queries::new(&none, grids(4, 2)).is_err());
    }

    #[test]
    fn as_many_keys_as_a_sensor_has_tokens() {
        assert_eq!((top(None, grids(8, 8)).unwrap(), top(None, grids(2, 2)).unwrap()), (5, 4));
        assert_eq!(top(Some(12), grids(8, 8)).unwrap(), 12);
        for wrong in [0, 5] {
            let error = top(Some(wrong), grids(2, 2)).unwrap_err();
            assert!(error.message.starts_with(&format!("found {wrong}, expected 1 to 4")), "{error}");
            assert_eq!((error.location.as_str(), error.help.as_str()), ("--top", "leave it out for the 4 strongest"));
        }
    }
}
