//! The `footprint` command.

use super::Common;
use crate::footprint;
use crate::report::{json, terminal};
use clap::Args;
use model_compiler::cli::Console;
use model_compiler::error::Result;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(super) struct FootprintArgs {
    /// Linked programs of a Cortex-M or 64-bit Arm.
    #[arg(value_name = "ELF", required = true)]
    programs: Vec<PathBuf>,
    /// Also bound the stack of this function (the end of its path, as `main` or `measure::step`); may be repeated. The
    /// program must be built with `-Z emit-stack-sizes`.
    #[arg(long, value_name = "FUNCTION")]
    stack: Vec<String>,
}

impl FootprintArgs {
    /// Measures the programs and shows them side by side.
    pub(super) fn execute(self, common: &Common, console: &mut Console<'_>) -> Result<u8> {
        let report = footprint::report(&self.programs, &self.stack)?;
        console.print(&if common.json { json::footprint(&report).to_string() } else { terminal::footprint(&report) });
        Ok(0)
    }
}
