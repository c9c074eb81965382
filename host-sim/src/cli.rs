//! The command line: `run`, `verify`, `diff`, `ablate`, `attention`, `drive`, `hil`, `score`, `bench`, `footprint`,
//! `schema`, `completions`, and the demo without any of them.
//!
//! Results go to stdout, everything else to stderr. Exit status: 0 success, 1 a check failed, 2 bad input or usage.

use crate::ablation;
use crate::backends::{Backend, BackendKind};
use crate::files::FrameSource;
use crate::report::{self, json, terminal};
use crate::{demo, drive, metrics, run};
use attention::AttentionArgs;
use bench::BenchArgs;
use clap::{Args, Parser, Subcommand};
use diff::DiffArgs;
use footprint::FootprintArgs;
use hil::HilArgs;
use indicatif::ProgressBar;
use model_compiler::cli::{CompletionArgs, ImportArgs, progress_bar};
use model_compiler::error::{Error, ErrorCode, Result};
use std::ffi::OsString;
use std::path::PathBuf;
use update::UpdateArgs;
use verify::VerifyArgs;

mod attention;
mod bench;
mod diff;
mod examples;
mod footprint;
mod gates;
mod hil;
mod update;
mod verify;

pub use model_compiler::cli::Console;

/// Runs a driving network on the firmware's own engine, and proves that its numbers are right.
#[derive(Debug, Parser)]
#[command(version, about, after_help = examples::ALL, args_conflicts_with_subcommands = true)]
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
    /// Waypoints, controls, points or classes of frames: int8 from a model image, f32 from a checkpoint or ONNX file.
    #[command(after_help = examples::RUN)]
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
    #[command(after_help = examples::VERIFY)]
    Verify {
        #[command(flatten)]
        verify: VerifyArgs,
        #[command(flatten)]
        common: Common,
    },
    /// What each choice of the quantizer is worth on a checkpoint: SQNR of the pooled vector, and error of waypoints or
    /// controls, or SQNR of the logits, and error of points or agreement of the classes.
    #[command(after_help = examples::ABLATE)]
    Ablate {
        /// Checkpoint.
        model: PathBuf,
        #[command(flatten)]
        import: ImportArgs,
        /// Calibration frames: a frame directory (for classifiers: of images) or a .safetensors file of raw inputs.
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
    /// How often tokens of one sensor attend to the other in a fusing transformer: integers, f32, and how far they
    /// agree.
    #[command(after_help = examples::ATTENTION)]
    Attention {
        #[command(flatten)]
        attention: AttentionArgs,
        #[command(flatten)]
        common: Common,
    },
    /// Replays a recorded sequence through sensors, network, planner and controller: steer, throttle and brake.
    #[command(after_help = examples::DRIVE)]
    Drive {
        /// Model image.
        #[arg(value_name = "OUT.img")]
        image: PathBuf,
        /// Folder with route.json and frames/<name>/{rgb.png, lidar.bin, frame.json}, a frame per 1/20 s.
        #[arg(long, value_name = "DIR")]
        log: PathBuf,
        /// The checkpoint that the image was compiled from; without it only the integers drive.
        #[arg(long, value_name = "MODEL")]
        model: Option<PathBuf>,
        #[command(flatten)]
        import: ImportArgs,
        #[command(flatten)]
        backend: BackendArgs,
        /// Write drive.html and drive.json to this folder.
        #[arg(long, value_name = "DIR")]
        report: Option<PathBuf>,
        #[command(flatten)]
        common: Common,
    },
    /// Feeds a board over its serial line, in the emulator or a real one, and compares every output byte with the host's.
    ///
    /// The board runs the `drive` program of firmware/boards. Exit status 1 at the first difference, 2 where the board is
    /// missing, silent, refuses, or holds another image.
    #[command(after_help = examples::HIL)]
    Hil {
        #[command(flatten)]
        hil: HilArgs,
        #[command(flatten)]
        common: Common,
    },
    /// Sends a board a new model image: checked there, started on trial, confirmed by its known answer.
    ///
    /// The old image runs until the new one is whole, and again if the new one fails. A lower revision and another
    /// board's target are refused before a byte is sent.
    #[command(after_help = examples::UPDATE)]
    Update {
        #[command(flatten)]
        update: UpdateArgs,
        #[command(flatten)]
        common: Common,
    },
    /// Driving score, route completion and infractions of logged drives.
    #[command(after_help = examples::SCORE)]
    Score {
        /// Logs, one route each (`host-sim schema route-log` prints the format).
        #[arg(value_name = "LOG.json", required = true)]
        logs: Vec<PathBuf>,
        #[command(flatten)]
        common: Common,
    },
    /// What changed from one report of a verification to another, without running anything.
    #[command(after_help = examples::DIFF)]
    Diff {
        #[command(flatten)]
        diff: DiffArgs,
        #[command(flatten)]
        common: Common,
    },
    /// JSON Schema of a document: of the report that `verify --json` and report.json hold, or another.
    #[command(after_help = examples::SCHEMA)]
    Schema {
        /// Which document.
        #[arg(value_name = "DOCUMENT", default_value = "verify")]
        document: json::Document,
        #[command(flatten)]
        common: Common,
    },
    /// Latency of a model image per step and whole, the backends of this machine side by side.
    ///
    /// One thread, seeded inputs (no figure depends on them), backends in turns. Times are CPU time of
    /// the thread; those of whole inferences also wall time. For steady figures give the process a core
    /// of its own: put `taskset -c N` in front of the command and let nothing else run there.
    #[command(after_help = examples::BENCH, verbatim_doc_comment)]
    Bench {
        #[command(flatten)]
        bench: BenchArgs,
        #[command(flatten)]
        common: Common,
    },
    /// Flash, RAM and stack of a firmware, from its linked ELF.
    #[command(after_help = examples::FOOTPRINT)]
    Footprint {
        #[command(flatten)]
        footprint: FootprintArgs,
        #[command(flatten)]
        common: Common,
    },
    /// Script that completes commands and options in a shell.
    #[command(after_help = examples::COMPLETIONS)]
    Completions(CompletionArgs),
}

#[derive(Debug, Args)]
struct BackendArgs {
    /// Kernels of the engine; all give the same bytes [default: the fastest of this machine].
    #[arg(long, value_name = "NAME")]
    backend: Option<BackendKind>,
}

impl BackendArgs {
    /// The backend asked for, else the fastest; with a fault the portable one, which alone has faults in its kernels.
    fn choose(&self, common: &Common) -> Result<Backend> {
        match self.backend {
            _ if !common.has_fault() => Backend::choose(self.backend),
            None | Some(BackendKind::Portable) => Backend::choose(Some(BackendKind::Portable)),
            Some(kind) => {
                let message = format!("the kernels of {} hold no faults", kind.name());
                Err(Error::new(ErrorCode::Usage, "--fault", message).with_help("use --backend portable"))
            }
        }
    }
}

#[derive(Debug, Args)]
struct Common {
    /// Machine-readable result on stdout, errors too.
    #[arg(long)]
    json: bool,
    /// Runs the engine with a named fault, to show that the comparison can fail; on the portable backend.
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
    let json = cli.common().is_some_and(|common| common.json);
    match cli.execute(&mut console) {
        Ok(status) => status,
        Err(error) => fail(&error, json, &mut console),
    }
}

impl Cli {
    fn common(&self) -> Option<&Common> {
        self.command.as_ref().map_or(Some(&self.common), Command::common)
    }

    fn execute(self, console: &mut Console<'_>) -> Result<u8> {
        self.common().map_or(Ok(()), Common::inject_fault)?;
        let progress = progress_bar();
        let status = match self.command {
            Some(command) => command.execute(console, &progress),
            None => show(self.out, self.common.json, console, &progress),
        };
        progress.finish_and_clear();
        status
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
        console.print(&json::verify(&report).to_string());
    }
    Ok(conclude(report.failure.as_ref(), json, console))
}

impl Command {
    fn common(&self) -> Option<&Common> {
        match self {
            Self::Run { common, .. }
            | Self::Verify { common, .. }
            | Self::Ablate { common, .. }
            | Self::Bench { common, .. }
            | Self::Diff { common, .. }
            | Self::Footprint { common, .. }
            | Self::Attention { common, .. }
            | Self::Drive { common, .. }
            | Self::Hil { common, .. }
            | Self::Update { common, .. }
            | Self::Score { common, .. }
            | Self::Schema { common, .. } => Some(common),
            Self::Completions(_) => None,
        }
    }

    fn execute(self, console: &mut Console<'_>, progress: &ProgressBar) -> Result<u8> {
        match self {
            Self::Run { model, import, frames, backend, common } => {
                let report = run::run(&model, &import.options()?, &frames, backend.choose(&common)?, progress)?;
                progress.finish_and_clear();
                console.print(&if common.json { json::run(&report).to_string() } else { terminal::run(&report) });
                Ok(0)
            }
            Self::Verify { verify, common } => verify.execute(&common, console, progress),
            Self::Ablate { model, import, calib, frames, mirror, common } => {
                let options = ablation::Options { model, import: import.options()?, calib, frames, mirror };
                let rows = ablation::ablate(&options, progress)?;
                console.print(&if common.json { json::ablation(&rows).to_string() } else { terminal::ablation(&rows) });
                Ok(0)
            }
            Self::Attention { attention, common } => attention.execute(&common, console, progress),
            Self::Drive { image, log, model, import, backend, report: folder, common } => {
                let (import, backend) = (import.options()?, backend.choose(&common)?);
                let report = drive::drive(&drive::Options { image, log, model, import, backend }, progress)?;
                if let Some(folder) = &folder {
                    report::write_drive(folder, &report)?;
                }
                console.print(&if common.json { json::drive(&report).to_string() } else { terminal::drive(&report) });
                Ok(0)
            }
            Self::Hil { hil, common } => hil.execute(&common, console, progress),
            Self::Update { update, common } => update.execute(&common, console, progress),
            Self::Score { logs, common } => {
                let score = metrics::score(&logs)?;
                console.print(&if common.json { json::score(&score).to_string() } else { terminal::score(&score) });
                Ok(0)
            }
            Self::Diff { diff, common } => diff.execute(&common, console),
            Self::Footprint { footprint, common } => footprint.execute(&common, console),
            Self::Schema { document, .. } => {
                console.print(&format!("{:#}", json::schema(document)));
                Ok(0)
            }
            Self::Bench { bench, common } => bench.execute(&common, console, progress),
            Self::Completions(shell) => {
                progress.finish_and_clear();
                console.print(&shell.script::<Cli>());
                Ok(0)
            }
        }
    }
}

impl Common {
    #[cfg(feature = "fault-injection")]
    fn has_fault(&self) -> bool {
        self.fault.is_some()
    }

    #[cfg(not(feature = "fault-injection"))]
    fn has_fault(&self) -> bool {
        false
    }

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

fn warn_of_calibration(known: &[String], frames: usize, console: &mut Console<'_>) {
    if !known.is_empty() {
        console.complain(&format!(
            "warning: {} of {frames} frames are also calibration frames, so figures against f32 flatter: {}",
            known.len(),
            known.join(", ")
        ));
    }
}

fn conclude(failure: Option<&Error>, json: bool, console: &mut Console<'_>) -> u8 {
    let Some(failure) = failure else { return 0 };
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

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    pub(super) fn parse(arguments: &str) -> std::result::Result<Cli, clap::Error> {
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
        assert!(parse("host-sim verify a.img --frames f --frames-limit 3 --resize 256").is_ok());
        assert!(parse("host-sim verify a.img --frames f --frames-limit 0").is_err());
        assert!(parse("host-sim verify a.img --frames-limit 3").is_err());
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
    fn every_command_has_examples_and_they_parse() {
        let program = Cli::command();
        for command in std::iter::once(&program).chain(program.get_subcommands()) {
            let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            let examples: Vec<&str> = help.lines().filter_map(|line| line.strip_prefix("  ")).collect();
            assert!(!examples.is_empty(), "{} has no examples", command.get_name());
            for example in examples {
                let words: Vec<&str> = example.split_whitespace().collect();
                Cli::try_parse_from(&words).unwrap_or_else(|e| panic!("{example}: {e}"));
                assert!(command.get_name() == "host-sim" || words[1] == command.get_name(), "{example}");
            }
        }
    }
}
