//! The route: which node to head for, and what to do there.

use super::Real;
use super::pose::Position;
use core::fmt;
use heapless::Deque;
use serde::{Deserialize, Serialize};

/// What the navigation asks for at a node of the route; the numbers are those of the simulator and of the networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum Command {
    /// Turn left at the intersection.
    Left = 1,
    /// Turn right at the intersection.
    Right = 2,
    /// Cross the intersection straight ahead.
    Straight = 3,
    /// Keep to the lane.
    LaneFollow = 4,
    /// Change to the lane on the left.
    ChangeLaneLeft = 5,
    /// Change to the lane on the right.
    ChangeLaneRight = 6,
}

impl Command {
    /// All commands, by number.
    pub const ALL: [Self; 6] =
        [Self::Left, Self::Right, Self::Straight, Self::LaneFollow, Self::ChangeLaneLeft, Self::ChangeLaneRight];

    /// The number, 1..=6.
    pub const fn code(self) -> u8 {
        self as u8
    }

    /// The command of a number; `None` outside 1..=6.
    pub fn from_code(code: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|command| command.code() == code)
    }
}

/// One node of the route.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct RouteNode {
    /// Where it is.
    pub position: Position,
    /// What to do there.
    pub command: Command,
}

/// How far the planner looks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Horizon {
    /// Meters from a node within which the vehicle has reached it.
    pub reach: Real,
    /// Meters along the route within which nodes may be reached.
    pub look_ahead: Real,
}

/// The route is full: the planner holds no more nodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct RouteFull {
    /// Nodes that fit.
    pub capacity: usize,
}

impl fmt::Display for RouteFull {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the route holds {} nodes; pass the next ones when nodes are behind the vehicle", self.capacity)
    }
}

impl core::error::Error for RouteFull {}

/// Follows a sparse route of at most N nodes. Nodes may be added while it is driven.
#[derive(Clone, Debug)]
pub struct Planner<const N: usize> {
    horizon: Horizon,
    nodes: Deque<RouteNode, N>,
}

impl<const N: usize> Planner<N> {
    /// Starts without a route.
    pub const fn new(horizon: Horizon) -> Self {
        Self { horizon, nodes: Deque::new() }
    }

    /// Adds a node at the end.
    ///
    /// # Errors
    ///
    /// [`RouteFull`] where N nodes are ahead.
    pub fn push(&mut self, node: RouteNode) -> Result<(), RouteFull> {
        self.nodes.push_back(node).map_err(|_| RouteFull { capacity: N })
    }

    /// Forgets the route.
    pub fn clear(&mut self) {
        self.nodes.clear();
    }

    /// Nodes of the route, the passed ones left out.
    pub fn nodes(&self) -> impl ExactSizeIterator<Item = &RouteNode> {
        self.nodes.iter()
    }

    /// Passes what is reached and gives the node to head for: the one behind the last passed, or the only one.
    ///
    /// Of the nodes behind the first, up to the one that ends the look-ahead, the *farthest* within reach counts as
    /// reached; it and the nodes before it become the passed ones, but two nodes always stay. `None` without a route.
    pub fn advance(&mut self, own: Position) -> Option<RouteNode> {
        for _ in 0..self.reached(own) {
            if self.nodes.len() <= 2 {
                break;
            }
            self.nodes.pop_front();
        }
        self.nodes.get(1).or(self.nodes.front()).copied()
    }

    /// Index of the node that counts as reached, 0 where none but the first may.
    fn reached(&self, own: Position) -> usize {
        // Below every distance: a node may lie exactly under the vehicle.
        let (mut reached, mut farthest, mut travel) = (0, -Real::ONE, Real::ZERO);
        let pairs = self.nodes.iter().zip(self.nodes.iter().enumerate().skip(1));
        for (before, (index, node)) in pairs {
            if travel > self.horizon.look_ahead {
                break;
            }
            travel = travel.saturating_add(before.position.distance(node.position));
            let distance = own.distance(node.position);
            if distance <= self.horizon.reach && distance > farthest {
                (reached, farthest) = (index, distance);
            }
        }
        reached
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "what is missing fails the test")]
mod tests {
    extern crate std;
    use super::*;
    use std::format;

    const HORIZON: Horizon = Horizon { reach: Real::lit("4"), look_ahead: Real::lit("50") };

    fn place(north: i32, east: i32) -> Position {
        Position { north: Real::from_num(north), east: Real::from_num(east) }
    }

    /// A route to the north with a node at each of these meters.
    fn planner(north: &[i32]) -> Planner<8> {
        let mut planner = Planner::new(HORIZON);
        for &north in north {
            planner.push(RouteNode { position: place(north, 0), command: Command::LaneFollow }).unwrap();
        }
        planner
    }

    fn next(planner: &mut Planner<8>, north: i32) -> Option<Position> {
        planner.advance(place(north, 0)).map(|node| node.position)
    }

    #[test]
    fn no_route_gives_no_node_and_one_node_is_kept() {
        assert_eq!(next(&mut planner(&[]), 0), None);
        assert_eq!(next(&mut planner(&[7]), 7), Some(place(7, 0)));
    }

    #[test]
    fn the_farthest_node_within_reach_is_passed() {
        let mut planner = planner(&[0, 10, 12, 30, 60]);
        assert_eq!(next(&mut planner, 0), Some(place(10, 0)));
        // 10 is 3 m behind, 12 is 1 m behind: 10 is the farther one, and only it is passed.
        assert_eq!(next(&mut planner, 13), Some(place(12, 0)));
        assert_eq!(planner.nodes().len(), 4);
    }

    #[test]
    fn a_node_under_the_vehicle_is_reached() {
        let mut planner = planner(&[0, 10, 30, 60]);
        assert_eq!(next(&mut planner, 10), Some(place(30, 0)));
    }

    #[test]
    fn a_node_behind_the_look_ahead_is_not_reached() {
        // The loop comes back to the start: the node at 1 m ends a way of 121 m.
        let mut planner = planner(&[0, 60, 1]);
        assert_eq!(next(&mut planner, 0), Some(place(60, 0)));
    }

    #[test]
    fn two_nodes_stay() {
        let mut planner = planner(&[0, 10]);
        for north in [10, 8, 500] {
            assert_eq!(next(&mut planner, north), Some(place(10, 0)));
        }
        assert_eq!(planner.nodes().len(), 2);
    }

    #[test]
    fn a_full_route_refuses_by_name() {
        let mut planner = planner(&[0; 8]);
        let refused = planner.push(RouteNode { position: place(0, 0), command: Command::Left }).unwrap_err();
        assert!(format!("{refused}").starts_with("the route holds 8 nodes"));
        planner.clear();
        assert_eq!(planner.nodes().len(), 0);
    }

    #[test]
    fn extreme_coordinates_give_a_node() {
        let ends = [Position { north: Real::MIN, east: Real::MAX }, Position { north: Real::MAX, east: Real::MIN }];
        let mut planner = Planner::<8>::new(HORIZON);
        for position in ends {
            planner.push(RouteNode { position, command: Command::Straight }).unwrap();
        }
        for own in ends {
            assert_eq!(planner.advance(own).map(|node| node.position), Some(ends[1]));
        }
    }

    #[test]
    fn commands_keep_their_numbers() {
        for code in 0..=u8::MAX {
            assert_eq!(Command::from_code(code).map(Command::code), (1..=6).contains(&code).then_some(code));
        }
        assert_eq!(Command::from_code(4), Some(Command::LaneFollow));
    }
}
