//! Counts over strongest keys.
//!
//! Per frame, a query looks across where, *in any of its heads*, at least one (or all) of its strongest keys is a token
//! of the other sensor. The percentages are over frames and queries. The heads are joined by "or" as in the script that
//! the authors released. That script does not run as it is, and its defects are not copied:
//! * LiDAR queries lack the offset of the image's tokens in one of its branches, so that image tokens were asked; here
//!   a LiDAR token counts from the end of the image's
//! * of equal weights it takes whichever a partial sort leaves in front; here the lowest token wins, and
//!   [`Statistics::tied_percent`] says how often that decides
//! * its frames are the first files of a folder; here they are the frames that were given

use super::AttentionMap;
use super::queries::Queries;
use schemars::JsonSchema;
use serde::Serialize;

/// The strongest keys of the queries on one frame.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct StrongestKeys {
    /// By head, then query: tokens, the strongest first; queries as in [`Queries::tokens`].
    pub keys: Vec<Vec<Vec<u16>>>,
    /// Rows whose last strongest key weighs as much as the next one, so that its place in the order decided.
    pub tied: u32,
}

impl StrongestKeys {
    /// The `top` strongest keys of every head and query.
    pub fn of(map: &AttentionMap, queries: &Queries, top: u16) -> Self {
        let mut tied = 0;
        let mut strongest_of = |head: usize, token: u16| {
            let (keys, is_tied) = strongest(map.row(head, token.into()), top.into());
            tied += u32::from(is_tied);
            keys
        };
        let keys = (0..map.heads).map(|head| queries.tokens().map(|token| strongest_of(head, token)).collect());
        Self { keys: keys.collect(), tied }
    }

    /// How many of the strongest keys of a query lie in the other sensor, by head.
    pub fn across<'a>(&'a self, query: usize, queries: &'a Queries) -> impl Iterator<Item = usize> + 'a {
        let is_lidar = query >= queries.image.tokens.len();
        let of_head =
            move |keys: &Vec<Vec<u16>>| keys[query].iter().filter(|&&k| queries.is_lidar(k) != is_lidar).count();
        self.keys.iter().map(of_head)
    }
}

/// The places of the largest weights, the largest first, of equal ones the lowest first; and whether the last of them
/// equals the next.
fn strongest(row: &[f32], count: usize) -> (Vec<u16>, bool) {
    let mut order: Vec<u16> = (0..row.len() as u16).collect();
    let weight = |&key: &u16| row[usize::from(key)];
    order.sort_by(|a, b| weight(b).total_cmp(&weight(a)));
    let is_tied = match (order.get(count.wrapping_sub(1)), order.get(count)) {
        (Some(last), Some(next)) => weight(last) == weight(next),
        _ => false,
    };
    order.truncate(count);
    (order, is_tied)
}

/// How often one sensor's queries look at the other.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, JsonSchema)]
pub struct CrossModal {
    /// Frames times queries.
    pub queries: u64,
    /// All strongest keys of a head in the other sensor, percent of the queries.
    pub all_percent: f64,
    /// At least one strongest key of a head in the other sensor, percent of the queries.
    pub any_percent: f64,
}

/// Figures of one network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, JsonSchema)]
pub struct Statistics {
    /// Queries of the camera image.
    pub image: CrossModal,
    /// Queries of the LiDAR histogram.
    pub lidar: CrossModal,
    /// Rows whose last strongest key is one by its place in the order alone, percent of frames times heads times
    /// queries. In integers weights below 2^-16 of the largest are all zero.
    pub tied_percent: f64,
}

/// Sums over frames.
#[derive(Clone, Copy, Debug, Default)]
pub struct Counts {
    image: SensorCounts,
    lidar: SensorCounts,
    rows: u64,
    tied: u64,
}

#[derive(Clone, Copy, Debug, Default)]
struct SensorCounts {
    queries: u64,
    all: u64,
    any: u64,
}

impl Counts {
    /// Adds a frame.
    pub fn add(&mut self, strongest: &StrongestKeys, queries: &Queries) {
        let top = strongest.keys.first().and_then(|head| head.first()).map_or(0, Vec::len);
        for query in 0..queries.tokens().count() {
            let sensor = if query < queries.image.tokens.len() { &mut self.image } else { &mut self.lidar };
            sensor.queries += 1;
            sensor.all += u64::from(strongest.across(query, queries).any(|count| count == top));
            sensor.any += u64::from(strongest.across(query, queries).any(|count| count > 0));
        }
        self.rows += strongest.keys.iter().map(|head| head.len() as u64).sum::<u64>();
        self.tied += u64::from(strongest.tied);
    }

    /// The percentages.
    pub fn figures(self) -> Statistics {
        let sensor = |SensorCounts { queries, all, any }| CrossModal {
            queries,
            all_percent: percent(all, queries),
            any_percent: percent(any, queries),
        };
        Statistics { image: sensor(self.image), lidar: sensor(self.lidar), tied_percent: percent(self.tied, self.rows) }
    }
}

/// How far the strongest keys of two networks are the same.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, JsonSchema)]
pub struct Agreement {
    /// Frames times heads times queries.
    pub rows: u64,
    /// Strongest keys that are among those of the other network, percent of all.
    pub keys_percent: f64,
    /// Rows whose strongest keys are the same as a set, percent.
    pub sets_percent: f64,
    /// Rows whose one strongest key is the same, percent.
    pub first_percent: f64,
}

/// Sums of [`Agreement`].
#[derive(Clone, Copy, Debug, Default)]
pub struct AgreementCounts {
    rows: u64,
    keys: u64,
    common: u64,
    sets: u64,
    first: u64,
}

impl AgreementCounts {
    /// Of one frame.
    pub fn of(one: &StrongestKeys, other: &StrongestKeys) -> Self {
        let mut counts = Self::default();
        for (one, other) in one.keys.iter().flatten().zip(other.keys.iter().flatten()) {
            let common = one.iter().filter(|key| other.contains(key)).count();
            counts.rows += 1;
            counts.keys += one.len() as u64;
            counts.common += common as u64;
            counts.sets += u64::from(common == one.len());
            counts.first += u64::from(one.first() == other.first());
        }
        counts
    }

    /// Adds those of another frame.
    pub fn add(&mut self, other: Self) {
        self.rows += other.rows;
        self.keys += other.keys;
        self.common += other.common;
        self.sets += other.sets;
        self.first += other.first;
    }

    /// The percentages.
    pub fn figures(self) -> Agreement {
        Agreement {
            rows: self.rows,
            keys_percent: percent(self.common, self.keys),
            sets_percent: percent(self.sets, self.rows),
            first_percent: percent(self.first, self.rows),
        }
    }
}

fn percent(part: u64, whole: u64) -> f64 {
    100.0 * part as f64 / whole.max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::super::block::{Grid, Grids};
    use super::super::queries::QueryRows;
    use super::*;

    /// Two sensors of 2×2 tokens; asked are tokens 0 and 1 of the image and 5 and 7 of the LiDAR.
    fn queries() -> Queries {
        let grid = Grid { rows: 2, columns: 2 };
        Queries::new(&QueryRows::default(), Grids { image: grid, lidar: grid }).unwrap()
    }

    /// A map of one row per query and head, the same for all where not given.
    fn map(heads: usize, rows: &[(usize, usize, [f32; 8])]) -> AttentionMap {
        let mut map = AttentionMap { tokens: 8, heads, weights: vec![0.0; 8 * heads * 8] };
        for (query, head, row) in rows {
            map.weights[(query * heads + head) * 8..][..8].copy_from_slice(row);
        }
        map
    }

    #[test]
    fn of_equal_weights_the_lowest_token_wins() {
        assert_eq!(strongest(&[1.0, 3.0, 2.0, 3.0], 2), (vec![1, 3], false));
        assert_eq!(strongest(&[1.0, 3.0, 3.0, 3.0], 2), (vec![1, 2], true));
        assert_eq!(strongest(&[0.0; 4], 3), (vec![0, 1, 2], true));
        assert_eq!(strongest(&[5.0, 6.0], 2), (vec![1, 0], false), "there is no next one");
    }

    #[test]
    fn heads_are_joined_by_or_and_sensors_counted_apart() {
        const OWN_IMAGE: [f32; 8] = [9.0, 8.0, 7.0, 6.0, 5.0, 4.0, 3.0, 2.0];
        const OWN_LIDAR: [f32; 8] = [2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0];
        const MIXED: [f32; 8] = [9.0, 0.0, 0.0, 0.0, 8.0, 0.0, 0.0, 0.0];
        let map = map(
            2,
            &[
                // One head all across, the other not at all.
                (0, 0, OWN_IMAGE),
                (0, 1, OWN_LIDAR),
                // No head.
                (1, 0, OWN_IMAGE),
                (1, 1, OWN_IMAGE),
                // One of two keys across, in one head.
                (5, 0, MIXED),
                (5, 1, OWN_LIDAR),
                // Both heads one of two: at least one, but in no head all.
                (7, 0, MIXED),
                (7, 1, MIXED),
            ],
        );
        let strongest = StrongestKeys::of(&map, &queries(), 2);
        assert_eq!(strongest.keys[0], [vec![0, 1], vec![0, 1], vec![0, 4], vec![0, 4]]);
        assert_eq!(strongest.keys[1], [vec![7, 6], vec![0, 1], vec![7, 6], vec![0, 4]]);
        assert_eq!(strongest.across(0, &queries()).collect::<Vec<_>>(), [0, 2]);
        assert_eq!(strongest.across(3, &queries()).collect::<Vec<_>>(), [1, 1]);
        let mut counts = Counts::default();
        counts.add(&strongest, &queries());
        counts.add(&strongest, &queries());
        let figures = counts.figures();
        assert_eq!(figures.image, CrossModal { queries: 4, all_percent: 50.0, any_percent: 50.0 });
        assert_eq!(figures.lidar, CrossModal { queries: 4, all_percent: 0.0, any_percent: 100.0 });
        assert_eq!(figures.tied_percent, 0.0);
    }

    #[test]
    fn ties_are_counted_per_row() {
        let strongest = StrongestKeys::of(&map(1, &[(0, 0, [3.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])]), &queries(), 2);
        assert_eq!(strongest.tied, 3, "all rows but the given one are equal weights");
        let mut counts = Counts::default();
        counts.add(&strongest, &queries());
        assert_eq!(counts.figures().tied_percent, 75.0);
    }

    #[test]
    fn agreement_is_about_sets_and_about_the_strongest() {
        let keys = |rows: [[u16; 2]; 4]| StrongestKeys { keys: vec![rows.map(|row| row.to_vec()).to_vec()], tied: 0 };
        let one = keys([[1, 2], [3, 4], [5, 6], [7, 0]]);
        let other = keys([[1, 2], [4, 3], [5, 7], [1, 2]]);
        let expected = Agreement { rows: 4, keys_percent: 62.5, sets_percent: 50.0, first_percent: 50.0 };
        assert_eq!(AgreementCounts::of(&one, &other).figures(), expected);
        let mut counts = AgreementCounts::of(&one, &other);
        counts.add(AgreementCounts::of(&one, &one));
        let expected = Agreement { rows: 8, keys_percent: 81.25, sets_percent: 75.0, first_percent: 75.0 };
        assert_eq!(counts.figures(), expected);
    }
}
