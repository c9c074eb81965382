//! The command line: `run`, `verify`, `ablate`, and the demo without any of them.
//!
//! Results go to stdout, everything else to stderr. Exit status: 0 success, 1 a check failed, 2 bad input or usage.

use crate::ablation;
use crate::backends::{Backend, BackendKind};
use crate::files::FrameSource;
use crate::report::{VerifyReport, json, terminal};
use crate::{demo, run, verify};
use clap::{Args, Parser, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};
use model_compiler::cli::ImportArgs;
use model_compiler::error::{Error, ErrorCode, Result};
use std::ffi::OsString;
use std::path::PathBuf;

pub use model_compiler::cli::Console;

const EXAMPLES: &str =
    "Without a command: the demo. It compiles the bundled network (small and untrained), runs it, verifies every
byte, and writes image, record and report.

Examples:
  host-sim
  host-sim run transfuser.img --frames frames/
  host-sim run transfuser.pth --inputs inputs.safetensors --json
  host-sim verify transfuser.img --model transfuser.pth --frames frames/ --mirror --min-sqnr 20
  host-sim verify transfuser.img --inputs inputs.safetensors
  host-sim ablate transfuser.pth --calib frames/ --frames drive/";

/// Runs a driving network on the firmware's own engine, and proves that its numbers are right.
#[derive(Debug, Parser)]
#[command(version, about, after_help = EXAMPLES, args_conflicts_with_subcommands = true)]
pub struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    /// Folder for the files of the demo [default: target/demo].
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    common: Common,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Waypoints of frames: int8 from a model image, f32 from a checkpoint or ONNX file.
    #[command(after_help = EXAMPLES)]
    Run {
        /// Model image (OUT.img), checkpoint or ONNX file.
        #[arg(value_name = "OUT.img|MODEL")]
        model: PathBuf,
        #[command(flatten)]
        import: ImportArgs,
        #[command(flatten)]
        frames: FrameSource,
        #[command(flatten)]
        backend: BackendArgs,
        #[command(flatten)]
        common: Common,
    },
    /// Compares every byte of every step with an f64 model, and every value with the f32 network.
    #[command(after_help = EXAMPLES)]
    Verify {
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
        /// Exit 1 where a step's SQNR against the f32 network is lower.
        #[arg(long, value_name = "DB")]
        min_sqnr: Option<f64>,
        #[command(flatten)]
        common: Common,
    },
    /// What each choice of the quantizer is worth on a checkpoint: SQNR of the pooled vector, waypoint error.
    #[command(after_help = EXAMPLES)]
    Ablate {
        /// Checkpoint.
        model: PathBuf,
        #[command(flatten)]
        import: ImportArgs,
        /// Calibration frames: a frame directory or a .safetensors file of raw inputs.
        #[arg(long, value_name = "FRAMES|FILE")]
        calib: PathBuf,
        #[command(flatten)]
        frames: FrameSource,
        /// Also evaluate on the mirror image of every frame.
        #[arg(long)]
        mirror: bool,
        #[command(flatten)]
        common: Common,
    },
}

#[derive(Debug, Args)]
struct BackendArgs {
    /// Kernels: portable, avx2 or avx512-vnni; all give the same bytes [default: the fastest of this machine].
    #[arg(long, value_name = "NAME")]
    backend: Option<BackendKind>,
}

impl BackendArgs {
    fn choose(&self) -> Result<Backend> {
        Backend::choose(self.backend)
    }
}

#[derive(Debug, Args)]
struct Common {
    /// Machine-readable result on stdout, errors too.
    #[arg(long)]
    json: bool,
    /// Runs the engine with a named fault, to show that the comparison can fail.
    #[cfg(feature = "fault-injection")]
    #[arg(long, value_name = "NAME")]
    fault: Option<String>,
}

/// Parses the arguments (the first is the program), runs the command, prints its result; returns the exit status.
pub fn main(arguments: impl IntoIterator<Item = OsString>, mut console: Console<'_>) -> u8 {
    let arguments: Vec<OsString> = arguments.into_iter().collect();
    let cli = match Cli::try_parse_from(&arguments) {
        Ok(cli) => cli,
        Err(error) => return usage(&error, arguments.iter().any(|argument| argument == "--json"), &mut console),
    };
    let json = cli.common().json;
    match cli.execute(&mut console) {
        Ok(status) => status,
        Err(error) => fail(&error, json, &mut console),
    }
}

impl Cli {
    fn common(&self) -> &Common {
        self.command.as_ref().map_or(&self.common, Command::common)
    }

    fn execute(self, console: &mut Console<'_>) -> Result<u8> {
        self.common().inject_fault()?;
        let progress = progress_bar();
        match self.command {
            Some(command) => command.execute(console, &progress),
            None => show(self.out, self.common.json, console, &progress),
        }
    }
}

/// The demo.
fn show(out: Option<PathBuf>, json: bool, console: &mut Console<'_>, progress: &ProgressBar) -> Result<u8> {
    let bundle = demo::Bundle::of_sources()?;
    let out = out.unwrap_or_else(|| bundle.default_out());
    let mut say = |text: &str| {
        if !json {
            progress.suspend(|| console.print(text));
        }
    };
    let report = demo::demo(&bundle, &out, progress, &mut say)?;
    if json {
        console.print(&demo::document(&report).to_string());
    }
    Ok(conclude(&report, json, console))
}

impl Command {
    fn common(&self) -> &Common {
        match self {
            Self::Run { common, .. } | Self::Verify { common, .. } | Self::Ablate { common, .. } => common,
        }
    }

    fn execute(self, console: &mut Console<'_>, progress: &ProgressBar) -> Result<u8> {
        match self {
            Self::Run { model, import, frames, backend, common } => {
                let report = run::run(&model, &import.options()?, &frames, backend.choose()?, progress)?;
                progress.finish_and_clear();
                console.print(&if common.json { json::run(&report).to_string() } else { terminal::run(&report) });
                Ok(0)
            }
            Self::Verify { image, model, import, frames, backend, record, mirror, min_sqnr, common } => {
                let import = import.options()?;
                let backend = backend.choose()?;
                let options =
                    verify::Options { image, record, model, import, frames, backend, mirror, min_sqnr_db: min_sqnr };
                let report = verify::verify(&options, progress)?;
                warn(&report, console);
                console.print(&if common.json { json::verify(&report).to_string() } else { terminal::verify(&report) });
                Ok(conclude(&report, common.json, console))
            }
            Self::Ablate { model, import, calib, frames, mirror, common } => {
                let options = ablation::Options { model, import: import.options()?, calib, frames, mirror };
                let rows = ablation::ablate(&options, progress)?;
                console.print(&if common.json { json::ablation(&rows).to_string() } else { terminal::ablation(&rows) });
                Ok(0)
            }
        }
    }
}

impl Common {
    #[cfg(feature = "fault-injection")]
    fn inject_fault(&self) -> Result<()> {
        use firmware::fault::{self, Fault};
        let Some(name) = &self.fault else { return Ok(()) };
        let name_of = |fault: &Fault| format!("{fault:?}");
        let fault = Fault::ALL.iter().find(|fault| name_of(fault).eq_ignore_ascii_case(name));
        let fault = fault.ok_or_else(|| {
            let names: Vec<String> = Fault::ALL.iter().map(name_of).collect();
            let error = Error::new(ErrorCode::Usage, "--fault", format!("no fault is called {name}"));
            error.with_help(format!("one of {}", names.join(", ")))
        })?;
        fault::set(Some(*fault));
        Ok(())
    }

    #[cfg(not(feature = "fault-injection"))]
    fn inject_fault(&self) -> Result<()> {
        Ok(())
    }
}

/// What a reader of the figures must know first.
fn warn(report: &VerifyReport, console: &mut Console<'_>) {
    if !report.calibration_frames.is_empty() {
        console.complain(&format!(
            "warning: {} of {} frames are also calibration frames, so figures against f32 flatter: {}",
            report.calibration_frames.len(),
            report.frames.len(),
            report.calibration_frames.join(", ")
        ));
    }
    for frame in report.frames.iter().filter(|frame| frame.dropped_points > 0) {
        let (name, points) = (&frame.name, frame.dropped_points);
        console.complain(&format!("warning: frame {name}: {points} LiDAR points are not finite and were left out"));
    }
}

fn conclude(report: &VerifyReport, json: bool, console: &mut Console<'_>) -> u8 {
    let Some(failure) = &report.failure else { return 0 };
    // The JSON document holds the failure already.
    if !json {
        console.complain(&format!("error: {failure}"));
    }
    failure.code.exit_status()
}

fn fail(error: &Error, json: bool, console: &mut Console<'_>) -> u8 {
    if json {
        console.print(&json::error(error).to_string());
    } else {
        console.complain(&format!("error: {error}"));
    }
    error.code.exit_status()
}

/// Help and version are no failures; everything else is.
fn usage(error: &clap::Error, json: bool, console: &mut Console<'_>) -> u8 {
    let text = error.render().to_string();
    if !error.use_stderr() {
        console.print(&text);
        return 0;
    }
    if !json {
        console.complain(text.trim_end());
        return ErrorCode::Usage.exit_status();
    }
    let message = text.strip_prefix("error: ").unwrap_or(&text).split("\n\nUsage:").next().unwrap_or_default();
    fail(&Error::new(ErrorCode::Usage, "command line", message.trim()), true, console)
}

/// On stderr, and only if that is a terminal.
fn progress_bar() -> ProgressBar {
    let style = ProgressStyle::with_template("{msg} [{wide_bar}] {percent} % {eta}").expect("the template is valid");
    ProgressBar::new(0).with_style(style.progress_chars("=> "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    fn parse(arguments: &str) -> std::result::Result<Cli, clap::Error> {
        Cli::try_parse_from(arguments.split(' '))
    }

    #[test]
    fn the_definition_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn frames_come_from_exactly_one_place() {
        assert!(parse("host-sim run a.img --frames f").is_ok());
        assert!(parse("host-sim run a.img --inputs f.safetensors --json").is_ok());
        assert!(parse("host-sim run a.img").is_err());
        assert!(parse("host-sim verify a.img --frames f --inputs g").is_err());
    }

    #[test]
    fn the_demo_takes_no_command() {
        let cli = Cli::try_parse_from(["host-sim"]).unwrap();
        assert!(cli.command.is_none() && cli.out.is_none());
        assert_eq!(parse("host-sim --out d --json").unwrap().out, Some("d".into()));
        assert!(parse("host-sim --out d run a.img --frames f").is_err());
        assert!(parse("host-sim fly").is_err());
    }

    #[test]
    fn verify_takes_its_options() {
        let cli = parse("host-sim verify a.img --model m.pth --frames f --mirror --min-sqnr 20.5 --record r").unwrap();
        let Some(Command::Verify { model, record, mirror, min_sqnr, .. }) = cli.command else { panic!("not verify") };
        assert_eq!((model, record), (Some("m.pth".into()), Some("r".into())));
        assert_eq!((mirror, min_sqnr), (true, Some(20.5)));
    }
}
