//! The `verify` command.

use super::gates::GateArgs;
use super::{BackendArgs, Common, conclude, warn_of_calibration};
use crate::files::FrameSource;
use crate::noise::{self, Selection};
use crate::report::{self, VerifyReport, json, terminal};
use crate::verify;
use clap::Args;
use indicatif::ProgressBar;
use model_compiler::cli::{Console, ImportArgs};
use model_compiler::error::Result;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(super) struct VerifyArgs {
    /// Model image.
    #[arg(value_name = "OUT.img")]
    image: PathBuf,
    /// The checkpoint or ONNX file that it was compiled from; without it only bytes are compared.
    #[arg(long, value_name = "MODEL")]
    model: Option<PathBuf>,
    #[command(flatten)]
    import: ImportArgs,
    #[command(flatten)]
    frames: FrameSource,
    #[command(flatten)]
    backend: BackendArgs,
    /// Build record of the image [default: OUT.record beside OUT.img].
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Also run the mirror image of every frame (more evaluation frames, unknown to the calibration).
    #[arg(long)]
    mirror: bool,
    #[command(flatten)]
    gates: GateArgs,
    /// Report of an earlier verification (report.json) to compare with, step by step.
    #[arg(long, value_name = "OLD.json")]
    baseline: Option<PathBuf>,
    /// Write report.html and report.json to this folder.
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
    /// Measure the share of each tensor in the output's noise in a large network, too: of the COUNT tensors with the
    /// lowest local SQNR [default: 64]. In a small network all of them are measured anyway.
    #[arg(long, value_name = "COUNT", num_args = 0..=1, require_equals = true)]
    noise_share: Option<Option<usize>>,
}

impl VerifyArgs {
    pub(super) fn execute(self, common: &Common, console: &mut Console<'_>, progress: &ProgressBar) -> Result<u8> {
        let selected = |count: Option<usize>| Selection::Lowest(count.unwrap_or(noise::DEFAULT_TENSORS));
        let options = verify::Options {
            image: self.image,
            record: self.record,
            model: self.model,
            import: self.import.options()?,
            frames: self.frames,
            backend: self.backend.choose(common)?,
            mirror: self.mirror,
            gates: self.gates.gates()?,
            baseline: self.baseline,
            noise: self.noise_share.map_or(Selection::WhereCheap, selected),
        };
        let verified = verify::verify(&options, progress)?;
        if let Some(folder) = &self.report {
            report::write(folder, &verified.report, &verified.frames)?;
        }
        let report = verified.report;
        warn(&report, console);
        console.print(&if common.json { json::verify(&report).to_string() } else { terminal::verify(&report) });
        Ok(conclude(report.failure.as_ref(), common.json, console))
    }
}

/// What a reader of the figures must know first.
fn warn(report: &VerifyReport, console: &mut Console<'_>) {
    warn_of_calibration(&report.calibration_frames, report.frames.len(), console);
    for frame in report.frames.iter().filter(|frame| frame.dropped_points > 0) {
        let (name, points) = (&frame.name, frame.dropped_points);
        console.complain(&format!("warning: frame {name}: {points} LiDAR points are not finite and were left out"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::Command;
    use crate::cli::tests::parse;

    #[test]
    fn verify_takes_its_options() {
        let cli = parse("host-sim verify a.img --model m.pth --frames f --mirror --min-sqnr 20.5 --record r").unwrap();
        let Some(Command::Verify { verify, .. }) = cli.command else { panic!("not verify") };
        let VerifyArgs { model, record, mirror, gates, noise_share, .. } = verify;
        assert_eq!((model, record), (Some("m.pth".into()), Some("r".into())));
        assert_eq!((mirror, gates.gates().unwrap().min_sqnr_db, noise_share), (true, Some(20.5), None));
        for (option, expected) in [("--noise-share", Some(None)), ("--noise-share=9", Some(Some(9)))] {
            let cli = parse(&format!("host-sim verify a.img --frames f {option}")).unwrap();
            let Some(Command::Verify { verify, .. }) = cli.command else { panic!("not verify") };
            assert_eq!(verify.noise_share, expected);
        }
    }
}
