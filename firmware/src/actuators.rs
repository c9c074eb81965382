//! The outputs that move the vehicle, over the traits of `embedded-hal`: three duty cycles and an enable pin.

#![deny(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic
)]

use crate::drive::{Output, Real, Status};
use core::fmt;
use embedded_hal::digital::OutputPin;
use embedded_hal::pwm::SetDutyCycle;
use serde::{Deserialize, Serialize};

/// What was set: duty cycles as the hardware counts them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Duties {
    /// 0 full left, half straight, the largest full right.
    pub steering: u16,
    /// 0 none, the largest full throttle.
    pub throttle: u16,
    /// 0 none, the largest full brake.
    pub brake: u16,
    /// Whether the vehicle is driven. Not in the safe state, in which what else can brake should.
    pub is_enabled: bool,
}

/// The first output that did not take its value. The others were set all the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[allow(missing_docs, reason = "the name is the documentation")]
pub enum ActuatorFault {
    Brake,
    Throttle,
    Steering,
    Enable,
}

impl fmt::Display for ActuatorFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Brake => "the brake's output failed",
            Self::Throttle => "the throttle's output failed",
            Self::Steering => "the steering's output failed",
            Self::Enable => "the enable pin failed",
        })
    }
}

impl core::error::Error for ActuatorFault {}

/// Something that does what a [driver](crate::drive::Driver) says.
pub trait Actuate {
    /// Sets all outputs.
    ///
    /// # Errors
    /// An output did not take its value; all others did.
    fn apply(&mut self, output: &Output) -> Result<Duties, ActuatorFault>;
}

/// Three duty cycles and a pin.
#[derive(Clone, Copy, Debug)]
pub struct Actuators<S, T, B, E> {
    /// Steering servo.
    pub steering: S,
    /// Throttle.
    pub throttle: T,
    /// Brake.
    pub brake: B,
    /// High while the vehicle is driven.
    pub enable: E,
}

impl<S: SetDutyCycle, T: SetDutyCycle, B: SetDutyCycle, E: OutputPin> Actuate for Actuators<S, T, B, E> {
    fn apply(&mut self, output: &Output) -> Result<Duties, ActuatorFault> {
        let controls = output.controls;
        let is_enabled = output.status == Status::Driving;
        // −1..=1 to 0..=1.
        let steering = Real::from_bits(controls.steer.saturating_add(Real::ONE).to_bits() >> 1);
        let duties = Duties {
            steering: duty(steering, self.steering.max_duty_cycle()),
            throttle: duty(controls.throttle, self.throttle.max_duty_cycle()),
            brake: duty(controls.brake, self.brake.max_duty_cycle()),
            is_enabled,
        };
        // The brake first, and all of them whatever one says.
        let brake = self.brake.set_duty_cycle(duties.brake).map_err(|_| ActuatorFault::Brake);
        let throttle = self.throttle.set_duty_cycle(duties.throttle).map_err(|_| ActuatorFault::Throttle);
        let steering = self.steering.set_duty_cycle(duties.steering).map_err(|_| ActuatorFault::Steering);
        let enable = self.enable.set_state(is_enabled.into()).map_err(|_| ActuatorFault::Enable);
        brake.and(throttle).and(steering).and(enable).map(|()| duties)
    }
}

/// A share of 0..=1 of the largest duty, to the nearest, ties up.
fn duty(share: Real, max: u16) -> u16 {
    let share = share.clamp(Real::ZERO, Real::ONE).to_bits().cast_unsigned();
    let product = share.wrapping_mul(max.into()).wrapping_add(1 << 31) >> 32;
    u16::try_from(product).unwrap_or(max)
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    reason = "what is missing fails the test"
)]
mod tests {
    use super::*;
    use crate::drive::{Controls, Fault};
    use core::convert::Infallible;
    use embedded_hal::digital;
    use embedded_hal::pwm::{self, ErrorKind};

    #[derive(Default)]
    struct Pwm {
        duty: u16,
        is_broken: bool,
    }

    impl pwm::ErrorType for Pwm {
        type Error = ErrorKind;
    }

    impl SetDutyCycle for Pwm {
        fn max_duty_cycle(&self) -> u16 {
            1000
        }

        fn set_duty_cycle(&mut self, duty: u16) -> Result<(), ErrorKind> {
            self.duty = duty;
            if self.is_broken { Err(ErrorKind::Other) } else { Ok(()) }
        }
    }

    #[derive(Default)]
    struct Pin(bool);

    impl digital::ErrorType for Pin {
        type Error = Infallible;
    }

    impl OutputPin for Pin {
        fn set_low(&mut self) -> Result<(), Infallible> {
            self.0 = false;
            Ok(())
        }

        fn set_high(&mut self) -> Result<(), Infallible> {
            self.0 = true;
            Ok(())
        }
    }

    fn actuators() -> Actuators<Pwm, Pwm, Pwm, Pin> {
        Actuators { steering: Pwm::default(), throttle: Pwm::default(), brake: Pwm::default(), enable: Pin(false) }
    }

    fn driving(steer: f64, throttle: f64, brake: f64) -> Output {
        let [steer, throttle, brake] = [steer, throttle, brake].map(Real::from_num);
        Output { controls: Controls { steer, throttle, brake }, status: Status::Driving }
    }

    #[test]
    fn shares_become_duties() {
        let mut actuators = actuators();
        let cases = [
            (driving(0.0, 0.0, 0.0), [500, 0, 0]),
            (driving(-1.0, 0.75, 1.0), [0, 750, 1000]),
            (driving(1.0, 1.0, 0.0005), [1000, 1000, 1]),
            (driving(7.0, -1.0, 0.000_499), [1000, 0, 0]),
        ];
        for (output, [steering, throttle, brake]) in cases {
            let expected = Duties { steering, throttle, brake, is_enabled: true };
            assert_eq!(actuators.apply(&output), Ok(expected));
            let set = [actuators.steering.duty, actuators.throttle.duty, actuators.brake.duty];
            assert_eq!((set, actuators.enable.0), ([steering, throttle, brake], true));
        }
        assert_eq!(duty(Real::MAX, u16::MAX), u16::MAX);
    }

    #[test]
    fn the_safe_state_brakes_and_disables() {
        let mut actuators = actuators();
        actuators.apply(&driving(0.0, 0.5, 0.0)).unwrap();
        let stop = Output { controls: Controls::stop(Real::ZERO), status: Status::Fault(Fault::NoRoute) };
        let expected = Duties { steering: 500, throttle: 0, brake: 1000, is_enabled: false };
        assert_eq!(actuators.apply(&stop), Ok(expected));
        assert!(!actuators.enable.0);
    }

    #[test]
    fn a_broken_output_is_named_and_the_others_are_set() {
        let mut actuators = actuators();
        actuators.throttle.is_broken = true;
        assert_eq!(actuators.apply(&driving(1.0, 0.5, 0.25)), Err(ActuatorFault::Throttle));
        assert_eq!((actuators.brake.duty, actuators.steering.duty, actuators.enable.0), (250, 1000, true));
        actuators.brake.is_broken = true;
        assert_eq!(actuators.apply(&driving(1.0, 0.5, 0.25)), Err(ActuatorFault::Brake));
    }
}
