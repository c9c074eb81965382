//! What the computer tells a debugger: `defmt` frames under the feature of that name, nothing without it.

use super::{StartError, StartTimes};
use crate::drive::Status;
use crate::image::Image;
use crate::link::{Refusal, StepReport};

/// Discards its arguments where nobody logs.
macro_rules! log {
    ($level:ident, $format:literal $(, $argument:expr)*) => {{
        #[cfg(feature = "defmt")]
        defmt::$level!($format $(, $argument)*);
        #[cfg(not(feature = "defmt"))]
        let _ = ($(&$argument,)*);
    }};
}

pub(super) fn started(board: &str, image: &Image<'_>, times: StartTimes) {
    log!(info, "{=str}: image {=str}, {=usize} bytes", board, image.name(), image.bytes().len());
    log!(info, "quantized model {=[u8]:02x}", image.qmodel_digest().as_slice());
    log!(info, "parse {=u64} ticks, check {=u64} ticks", times.parse, times.check);
}

pub(super) fn no_image(board: &str, error: StartError) {
    log!(error, "{=str}: no image to run: {}", board, error);
}

pub(super) fn step(report: &StepReport) {
    log!(debug, "step {=u16}: {=u64} ticks", report.step, report.ticks);
}

pub(super) fn refused(request: u16, reason: Refusal) {
    log!(warn, "request {=u16} refused: {}", request, reason);
}

/// A frame ended, or the vehicle was stopped between two.
pub(super) fn ended(frame: u32, status: Status, ticks: u64) {
    match status {
        Status::Fault(fault) => log!(warn, "frame {=u32}: {}, {=u64} ticks", frame, fault, ticks),
        status => log!(info, "frame {=u32}: {}, {=u64} ticks", frame, status, ticks),
    }
}

pub(super) fn self_test_failed(reason: Refusal) {
    log!(error, "self-test failed: {}", reason);
}
