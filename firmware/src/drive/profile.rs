//! The six systems as data.

use super::Real;
use super::controller::Tuning;
use super::projection::GroundCamera;
use super::route::Horizon;
use super::schedule::Cadence;
use super::supervision::Limits;

/// A published driving system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[allow(missing_docs, reason = "the name is the documentation")]
pub enum System {
    TransFuser,
    Aim,
    LateFusion,
    GeometricFusion,
    Cilrs,
    Lbc,
}

/// How the network's answer becomes controls.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// Waypoints in the vehicle's frame, for the controller.
    Waypoints,
    /// Points in the image of this camera; their ground points are the controller's waypoints.
    ImagePoints(GroundCamera),
    /// Steer, throttle and brake themselves.
    Controls,
}

/// All that distinguishes one system from another outside its network. Fields may be changed for another vehicle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Profile {
    /// How the network answers.
    pub answer: Answer,
    /// Constants of the controller.
    pub tuning: Tuning,
    /// How far the route planner looks.
    pub horizon: Horizon,
    /// When the network runs.
    pub cadence: Cadence,
    /// The heading, in radians, that stands for a compass without a number; `None` makes that a fault.
    pub substitute_heading: Option<Real>,
    /// What the supervision accepts.
    pub limits: Limits,
}

impl System {
    /// The system of a network by the names of its inputs; `None` where they are no driving network's.
    pub fn of_inputs(reads: impl Fn(&str) -> bool) -> Option<Self> {
        match (reads("rgb"), reads("bev"), reads("goal")) {
            _ if reads("views") => Some(Self::Lbc),
            (true, false, false) if reads("command") => Some(Self::Cilrs),
            (true, true, true) if reads("bev_points") => Some(Self::GeometricFusion),
            (true, true, true) if reads("velocity") => Some(Self::TransFuser),
            (true, true, true) => Some(Self::LateFusion),
            (true, false, true) => Some(Self::Aim),
            _ => None,
        }
    }

    /// The system as published. The authors' TransFuser agent alone has a substitute for a compass that is not a
    /// number; their other agents would pass the NaN on to the network.
    pub const fn profile(self) -> Profile {
        const HORIZON: Horizon = Horizon { reach: Real::lit("4"), look_ahead: Real::lit("50") };
        const LBC_HORIZON: Horizon = Horizon { reach: Real::lit("7.5"), look_ahead: Real::lit("25") };
        let published = Profile {
            answer: Answer::Waypoints,
            tuning: Tuning::BASELINES,
            horizon: HORIZON,
            cadence: Cadence::EveryStep,
            substitute_heading: None,
            limits: Limits::CAMERA_AND_LIDAR,
        };
        match self {
            Self::TransFuser => Profile {
                tuning: Tuning::TRANSFUSER,
                cadence: Cadence::EvenSteps,
                substitute_heading: Some(Real::ZERO),
                ..published
            },
            Self::LateFusion | Self::GeometricFusion => published,
            Self::Aim => Profile { limits: Limits::CAMERA, ..published },
            Self::Cilrs => Profile { answer: Answer::Controls, limits: Limits::CAMERA_WITHOUT_COMPASS, ..published },
            Self::Lbc => Profile {
                answer: Answer::ImagePoints(GroundCamera::LBC),
                horizon: LBC_HORIZON,
                limits: Limits::CAMERA,
                ..published
            },
        }
    }
}
