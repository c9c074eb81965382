//! Infractions and what each costs.

use super::log::{Event, EventKind};
use schemars::JsonSchema;
use serde::Serialize;

impl EventKind {
    /// Every kind.
    pub const ALL: [Self; 5] =
        [Self::CollisionPedestrian, Self::CollisionVehicle, Self::CollisionStatic, Self::RedLight, Self::StopSign];

    /// The factor that each such event puts on the score.
    pub const fn factor(self) -> f64 {
        match self {
            Self::CollisionPedestrian => 0.50,
            Self::CollisionVehicle => 0.60,
            Self::CollisionStatic => 0.65,
            Self::RedLight => 0.70,
            Self::StopSign => 0.80,
        }
    }
}

/// Number of events of each kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, JsonSchema)]
pub struct Infractions {
    /// Collisions with pedestrians.
    pub collision_pedestrian: u32,
    /// Collisions with other vehicles.
    pub collision_vehicle: u32,
    /// Collisions with what does not move.
    pub collision_static: u32,
    /// Red lights.
    pub red_light: u32,
    /// Stop signs.
    pub stop_sign: u32,
}

impl Infractions {
    /// Counts events.
    pub fn of<'a>(events: impl IntoIterator<Item = &'a Event>) -> Self {
        let mut counts = Self::default();
        for event in events {
            *match event.kind {
                EventKind::CollisionPedestrian => &mut counts.collision_pedestrian,
                EventKind::CollisionVehicle => &mut counts.collision_vehicle,
                EventKind::CollisionStatic => &mut counts.collision_static,
                EventKind::RedLight => &mut counts.red_light,
                EventKind::StopSign => &mut counts.stop_sign,
            } += 1;
        }
        counts
    }

    /// Number of events of a kind.
    pub fn count(&self, kind: EventKind) -> u32 {
        match kind {
            EventKind::CollisionPedestrian => self.collision_pedestrian,
            EventKind::CollisionVehicle => self.collision_vehicle,
            EventKind::CollisionStatic => self.collision_static,
            EventKind::RedLight => self.red_light,
            EventKind::StopSign => self.stop_sign,
        }
    }

    /// P: a factor per event and, once, `1 − percent/100` for the part of the way outside the lanes.
    pub fn penalty(&self, outside_lanes_percent: f64) -> f64 {
        let events = EventKind::ALL.iter().map(|&kind| kind.factor().powi(self.count(kind) as i32));
        events.product::<f64>() * (1.0 - outside_lanes_percent / 100.0)
    }
}
