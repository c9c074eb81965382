//! The order of several cameras.

use serde::{Deserialize, Serialize};

/// A camera by where it looks, in the order in which networks read them. TransFuser and AIM read the first view or
/// all; LBC reads the first three, interleaved into one map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum View {
    /// Straight ahead.
    Front = 0,
    /// Turned to the left: 60° (LBC: 45°).
    Left = 1,
    /// Turned to the right by as much.
    Right = 2,
    /// Straight behind.
    Rear = 3,
}

impl View {
    /// All views in order.
    pub const ALL: [Self; 4] = [Self::Front, Self::Left, Self::Right, Self::Rear];
    /// The views of LBC in order.
    pub const LBC: [Self; 3] = [Self::Front, Self::Left, Self::Right];

    /// First of the view's three channels in a map that interleaves the views.
    pub const fn first_channel(self) -> u16 {
        match self {
            Self::Front => 0,
            Self::Left => 3,
            Self::Right => 6,
            Self::Rear => 9,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_follow_each_other_by_three_channels() {
        for (position, view) in (0_u16..).zip(View::ALL) {
            assert_eq!(view.first_channel(), 3 * position);
        }
        assert_eq!(View::LBC, View::ALL[..3]);
    }
}
