//! What a driving network answers, in the numbers that the firmware's driver takes.

use crate::run::Waypoints;
use firmware::drive::profile::Answer as AnswerKind;
use firmware::drive::{NetworkError, NetworkOutput};
use firmware::image::Image;
use firmware::link;
use firmware::waypoint::{self, Waypoint};

/// Name of the output that holds controls; waypoints and points are the first output.
pub const CONTROLS: &str = "controls";

/// The output of an image that drives.
pub fn output_of(image: &Image<'_>) -> u8 {
    let controls = |&index: &_| image.output(index).is_some_and(|port| port.name == CONTROLS);
    (0..image.output_count()).find(controls).unwrap_or(0)
}

/// What a network gave, owned.
#[derive(Clone, Debug, PartialEq)]
pub enum Answer {
    /// Waypoints.
    Waypoints(Vec<Waypoint>),
    /// Points in the image, `[column, row]` in 1/64 pixel.
    ImagePoints(Vec<[i32; 2]>),
    /// Logistic values in Q15.
    Controls([i16; 3]),
    /// Nothing that can be driven: a number that is not finite.
    NotFinite,
}

impl Answer {
    /// Reads the integers of an image's output that drives; `None` where it is none of a driving network.
    pub fn of_codes(kind: &AnswerKind, codes: &[i32]) -> Option<Self> {
        let bytes: Vec<u8> = codes.iter().flat_map(|code| code.to_le_bytes()).collect();
        match kind {
            AnswerKind::Waypoints => waypoint::read(&bytes).map(|waypoints| Self::Waypoints(waypoints.to_vec())),
            AnswerKind::ImagePoints(_) => Some(Self::ImagePoints(codes.as_chunks::<2>().0.to_vec())),
            AnswerKind::Controls => {
                let codes = <[i32; 3]>::try_from(codes).ok()?;
                Some(Self::Controls(codes.map(|code| code.clamp(i16::MIN.into(), i16::MAX.into()) as i16)))
            }
        }
    }

    /// What a board told; `None` where its network gave nothing to drive by.
    pub fn of_board(told: &link::Answer) -> Option<Self> {
        match told {
            link::Answer::None => None,
            link::Answer::Waypoints(waypoints) => Some(Self::Waypoints(waypoints.to_vec())),
            link::Answer::ImagePoints(points) => Some(Self::ImagePoints(points.to_vec())),
            link::Answer::Controls(codes) => Some(Self::Controls(*codes)),
        }
    }

    /// Reads real values of the same output: meters, pixels, logistic values. They are rounded to an image's integers,
    /// so those of an image come back as they were.
    pub fn of_real<T: Copy + Into<f64>>(kind: &AnswerKind, values: &[T]) -> Option<Self> {
        let factor = match kind {
            AnswerKind::Waypoints => 65536.0,
            AnswerKind::ImagePoints(_) => 64.0,
            AnswerKind::Controls => 32768.0,
        };
        let values = || values.iter().map(|&value| value.into());
        if !values().all(f64::is_finite) {
            return Some(Self::NotFinite);
        }
        // A cast saturates.
        let codes: Vec<i32> = values().map(|value| (value * factor + 0.5).floor() as i32).collect();
        Self::of_codes(kind, &codes)
    }

    /// As the driver takes it.
    ///
    /// # Errors
    /// There is nothing to drive by.
    pub fn output(&self) -> std::result::Result<NetworkOutput<'_>, NetworkError> {
        match self {
            Self::Waypoints(waypoints) => Ok(NetworkOutput::Waypoints(waypoints)),
            Self::ImagePoints(points) => Ok(NetworkOutput::ImagePoints(points)),
            Self::Controls(codes) => Ok(NetworkOutput::Controls(*codes)),
            Self::NotFinite => Err(NetworkError::Failed),
        }
    }

    /// Points in the image `[column, row]` in pixels, where the network gives such.
    pub fn points_px(&self) -> Option<Vec<[f64; 2]>> {
        match self {
            Self::ImagePoints(points) => {
                Some(points.iter().map(|point| point.map(|code| f64::from(code) / 64.0)).collect())
            }
            _ => None,
        }
    }

    /// Waypoints in meters, where the network gives such.
    pub fn waypoints(&self) -> Option<Waypoints> {
        match self {
            Self::Waypoints(waypoints) => {
                Some(waypoints.iter().map(|w| [w.right, w.forward].map(|meters| meters.to_num())).collect())
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use firmware::drive::System;

    #[test]
    fn integers_come_back_from_their_real_values() {
        for (system, unit) in [(System::Aim, 65536.0), (System::Lbc, 64.0), (System::Cilrs, 32768.0)] {
            let kind = system.profile().answer;
            let codes = if system == System::Cilrs { vec![1, 32767, -5] } else { vec![1, -70_001, i32::MAX, i32::MIN] };
            let values: Vec<f64> = codes.iter().map(|&code| f64::from(code) / unit).collect();
            let expected = Answer::of_codes(&kind, &codes);
            assert!(expected.is_some());
            assert_eq!(Answer::of_real(&kind, &values), expected, "{system:?}");
        }
    }

    #[test]
    fn a_number_that_is_not_finite_is_nothing_to_drive_by() {
        let kind = System::Aim.profile().answer;
        let answer = Answer::of_real(&kind, &[0.0, f32::NAN]).unwrap();
        assert_eq!(answer.output(), Err(NetworkError::Failed));
        assert_eq!(Answer::of_real(&kind, &[0.0_f32; 3]), None, "no pairs");
    }
}
