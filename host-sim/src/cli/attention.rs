//! The `attention` command.

use super::gates::percent;
use super::{BackendArgs, Common, conclude, warn_of_calibration};
use crate::attention::block::BlockChoice;
use crate::attention::queries::QueryRows;
use crate::attention::{Options, attention};
use crate::files::FrameSource;
use crate::report::{self, json, terminal};
use clap::Args;
use indicatif::ProgressBar;
use model_compiler::cli::{Console, ImportArgs};
use model_compiler::error::Result;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(super) struct AttentionArgs {
    /// Model image (OUT.img), or a checkpoint for its f32 network alone.
    #[arg(value_name = "OUT.img|MODEL")]
    model: PathBuf,
    /// The checkpoint that the image was compiled from; without it only the integers are looked at.
    #[arg(long = "model", value_name = "MODEL")]
    checkpoint: Option<PathBuf>,
    #[command(flatten)]
    import: ImportArgs,
    #[command(flatten)]
    frames: FrameSource,
    #[command(flatten)]
    backend: BackendArgs,
    /// Build record of the image, for the names of its blocks [default: OUT.record beside OUT.img, if it is there].
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Attention block: a name, or a module of which the last block is taken (encoder.transformer2), or last.
    #[arg(long, value_name = "NAME", default_value = "last")]
    block: BlockChoice,
    /// Rows of the image tokens whose queries count, from above, the first is 0 [default: as in the paper, 2,3,4 of 8
    /// rows, and as much of other grids].
    #[arg(long, value_name = "ROW,…", value_delimiter = ',')]
    image_rows: Option<Vec<u16>>,
    /// The same of the LiDAR tokens, from far to near [default: as in the paper, 4,5,6 of 8 rows].
    #[arg(long, value_name = "ROW,…", value_delimiter = ',')]
    lidar_rows: Option<Vec<u16>>,
    /// Strongest keys of each query and head [default: 5, or as many as a sensor has tokens].
    #[arg(long, value_name = "N")]
    top: Option<u16>,
    /// Exit 1 where integers and f32 have fewer of the strongest keys in common.
    #[arg(long, value_name = "PERCENT", value_parser = percent)]
    min_agreement: Option<f64>,
    /// Write attention.html and attention.json to this folder.
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
}

impl AttentionArgs {
    pub(super) fn execute(self, common: &Common, console: &mut Console<'_>, progress: &ProgressBar) -> Result<u8> {
        let options = Options {
            model: self.model,
            checkpoint: self.checkpoint,
            record: self.record,
            import: self.import.options()?,
            frames: self.frames,
            backend: self.backend.choose(common)?,
            block: self.block,
            rows: QueryRows { image: self.image_rows, lidar: self.lidar_rows },
            top: self.top,
            min_agreement_percent: self.min_agreement,
        };
        let measured = attention(&options, progress)?;
        if let Some(folder) = &self.report {
            report::write_attention(folder, &measured)?;
        }
        let report = measured.report;
        warn_of_calibration(&report.calibration_frames, report.frames.len(), console);
        let text = || terminal::attention(&report);
        console.print(&if common.json { json::attention(&report).to_string() } else { text() });
        Ok(conclude(report.failure.as_ref(), common.json, console))
    }
}
