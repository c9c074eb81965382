//! The `update` command.

use super::Common;
use super::hil::PlaceArgs;
use crate::hil::update::{self, Options};
use crate::report::{json, terminal};
use clap::Args;
use indicatif::ProgressBar;
use model_compiler::cli::Console;
use model_compiler::error::Result;
use std::path::PathBuf;
use std::time::Duration;

#[derive(Debug, Args)]
pub(super) struct UpdateArgs {
    /// The new model image.
    #[arg(value_name = "NEW.img")]
    image: PathBuf,
    #[command(flatten)]
    place: PlaceArgs,
    /// The image that an emulated board runs before.
    #[arg(long, value_name = "OLD.img", requires = "board")]
    running: Option<PathBuf>,
    /// How long nothing may go either way before the board counts as silent.
    #[arg(long, value_name = "SECONDS", default_value_t = 300, value_parser = clap::value_parser!(u64).range(1..))]
    timeout: u64,
}

impl UpdateArgs {
    pub(super) fn execute(self, common: &Common, console: &mut Console<'_>, progress: &ProgressBar) -> Result<u8> {
        let timeout = Duration::from_secs(self.timeout);
        let options = Options { image: self.image, place: self.place.place(), running: self.running, timeout };
        let report = update::update(&options, progress)?;
        progress.finish_and_clear();
        console.print(&if common.json { json::update(&report).to_string() } else { terminal::update(&report) });
        Ok(0)
    }
}
