//! The `diff` command.

use super::{Common, conclude};
use crate::diff::Diff;
use crate::gates;
use crate::report::{html, json, terminal};
use clap::Args;
use model_compiler::artifact;
use model_compiler::cli::Console;
use model_compiler::error::{Error, Result};
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(super) struct DiffArgs {
    /// Earlier report (report.json).
    #[arg(value_name = "OLD.json")]
    old: PathBuf,
    /// Later report.
    #[arg(value_name = "NEW.json")]
    new: PathBuf,
    /// Exit 1 where a step lost more.
    #[arg(long, value_name = "DB")]
    max_loss: Option<f64>,
    /// Write diff.html and diff.json to this folder.
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
}

impl DiffArgs {
    /// Shows the changes between two reports and checks the gate on them.
    pub(super) fn execute(self, common: &Common, console: &mut Console<'_>) -> Result<u8> {
        let diff = Diff::between(&json::read(&self.old)?, &json::read(&self.new)?)?;
        let gates: Vec<_> = self.max_loss.map(|limit| gates::loss(&diff, limit)).into_iter().collect();
        let failure = gates::failure(&gates);
        let document = json::diff(&diff, &gates, failure.as_ref());
        if let Some(folder) = &self.report {
            std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, &e))?;
            let page = html::diff_page(&diff, &gates);
            artifact::write_files(&[
                (&folder.join("diff.html"), page.as_bytes()),
                (&folder.join("diff.json"), &json::bytes(&document)),
            ])?;
        }
        let text = || terminal::diff(&diff) + &terminal::gates(&gates);
        console.print(&if common.json { document.to_string() } else { text() });
        Ok(conclude(failure.as_ref(), common.json, console))
    }
}
