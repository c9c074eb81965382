//! Gates on the command line.

use crate::gates::{self, Gates};
use clap::Args;
use model_compiler::error::Result;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(super) struct GateArgs {
    /// Exit 1 where a step's SQNR against the f32 network is lower.
    #[arg(long, value_name = "DB")]
    min_sqnr: Option<f64>,
    /// Exit 1 where the first output's SQNR against the f32 network is lower.
    #[arg(long, value_name = "DB")]
    min_output_sqnr: Option<f64>,
    /// Exit 1 where a step lost more against the baseline.
    #[arg(long, value_name = "DB")]
    max_loss: Option<f64>,
    /// Exit 1 where the classes of int8 and f32 agree on fewer frames.
    #[arg(long, value_name = "PERCENT", value_parser = percent)]
    min_agreement: Option<f64>,
    /// Exit 1 where the class is the label on fewer frames.
    #[arg(long, value_name = "PERCENT", value_parser = percent)]
    min_top1: Option<f64>,
    /// Exit 1 where a limit of this file is missed: min_sqnr_db, min_output_sqnr_db, max_waypoint_error_mm,
    /// max_control_error, max_point_error_px, min_agreement_percent, min_top1_percent, max_arena_bytes,
    /// max_flash_bytes, max_loss_db, and [steps] with "PATTERN" = dB.
    #[arg(long, value_name = "FILE.toml")]
    gate: Option<PathBuf>,
}

/// A percentage; a share such as 0.9 would be a gate that nothing ever misses.
pub(super) fn percent(text: &str) -> std::result::Result<f64, String> {
    let percent = text.parse::<f64>().ok().filter(|p| gates::is_percentage(*p));
    percent.ok_or_else(|| format!("found {text:?}, expected {}", gates::PERCENTAGE))
}

impl GateArgs {
    pub(super) fn gates(&self) -> Result<Gates> {
        let file = self.gate.as_deref().map(Gates::read).transpose()?.unwrap_or_default();
        let arguments = Gates {
            min_sqnr_db: self.min_sqnr,
            min_output_sqnr_db: self.min_output_sqnr,
            max_loss_db: self.max_loss,
            min_agreement_percent: self.min_agreement,
            min_top1_percent: self.min_top1,
            ..Gates::default()
        };
        Ok(arguments.or(file))
    }
}
