//! The `hil` command.

use super::{BackendArgs, Common, conclude};
use crate::files::{FrameSelection, FrameSource};
use crate::hil::emulator::Board;
use crate::hil::session::Tolerance;
use crate::hil::{self, Feed, Place};
use crate::report::{json, terminal};
use clap::Args;
use indicatif::ProgressBar;
use model_compiler::cli::Console;
use model_compiler::error::Result;
use std::path::PathBuf;
use std::time::Duration;

#[derive(Debug, Args)]
pub(super) struct HilArgs {
    /// Model image.
    #[arg(value_name = "OUT.img")]
    image: PathBuf,
    #[command(flatten)]
    place: PlaceArgs,
    #[command(flatten)]
    feed: FeedArgs,
    #[command(flatten)]
    backend: BackendArgs,
    /// Compare the CRC of every step, too, and show what each took.
    #[arg(long)]
    steps: bool,
    /// How long nothing may go either way before the board counts as silent.
    #[arg(long, value_name = "SECONDS", default_value_t = 300, value_parser = clap::value_parser!(u64).range(1..))]
    timeout: u64,
    /// Time that a network may take on the board [default: any].
    #[arg(long, value_name = "MS", default_value_t = u32::MAX, hide_default_value = true)]
    budget_ms: u32,
    /// Time from frame to frame in a drive after which the board stops the vehicle; 0: any.
    #[arg(long, value_name = "MS", default_value_t = 0)]
    silence_ms: u32,
    /// Let the board test image and known answer again and again while nothing else is to do.
    #[arg(long)]
    background: bool,
    /// Do not ask for the image's known answer before the first frame.
    #[arg(long)]
    no_self_test: bool,
    /// Show on stderr what the emulated program logs by defmt (of a build with --features defmt).
    #[arg(long, conflicts_with = "port")]
    defmt: bool,
}

#[derive(Debug, Args)]
pub(super) struct PlaceArgs {
    /// Board of firmware/boards, in QEMU.
    #[arg(long, value_name = "NAME", required_unless_present = "port", conflicts_with = "port")]
    board: Option<Board>,
    /// Serial device with a board that holds the image.
    #[arg(long, value_name = "DEVICE")]
    port: Option<String>,
    /// Rate of the serial device.
    #[arg(long, value_name = "N", requires = "port", default_value_t = hil::DEFAULT_BAUD)]
    baud: u32,
    /// Program of the emulated board [default: target/mcu/…/BOARD-drive of the source tree].
    #[arg(long, value_name = "ELF", conflicts_with = "port")]
    program: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct FeedArgs {
    /// Frame directory, for driving networks as sensor data; for classifiers a folder of images.
    #[arg(long, value_name = "DIR", required_unless_present_any = ["inputs", "log"])]
    #[arg(conflicts_with_all = ["inputs", "log"])]
    frames: Option<PathBuf>,
    /// Raw network inputs by name, first dimension = frames.
    #[arg(long, value_name = "FILE.safetensors", conflicts_with = "log")]
    inputs: Option<PathBuf>,
    /// Recorded sequence (the format of `host-sim drive`), driven step by step.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["crop", "frames_limit", "resize"])]
    log: Option<PathBuf>,
    /// Send the network's inputs as the host prepares them, in place of sensor data.
    #[arg(long)]
    crop: bool,
    #[command(flatten)]
    selection: FrameSelection,
}

impl PlaceArgs {
    pub(super) fn place(self) -> Place {
        match (self.port, self.board) {
            (Some(device), _) => Place::Port { device, baud: self.baud },
            (None, board) => Place::Emulated { board: board.unwrap_or(Board::An386), program: self.program },
        }
    }
}

impl FeedArgs {
    fn feed(self) -> Feed {
        let Self { frames, inputs, log, crop, selection } = self;
        log.map_or_else(|| Feed::Frames { source: FrameSource { frames, inputs, selection }, crop }, Feed::Log)
    }
}

impl HilArgs {
    pub(super) fn execute(self, common: &Common, console: &mut Console<'_>, progress: &ProgressBar) -> Result<u8> {
        let options = hil::Options {
            image: self.image,
            place: self.place.place(),
            feed: self.feed.feed(),
            steps: self.steps,
            backend: self.backend.choose(common)?,
            tolerance: Tolerance {
                budget_ms: self.budget_ms,
                silence_ms: self.silence_ms,
                tests_in_background: self.background,
                needs_self_test: !self.no_self_test,
            },
            timeout: Duration::from_secs(self.timeout),
            defmt: self.defmt,
        };
        let report = hil::hil(&options, progress, &mut |line| progress.suspend(|| console.complain(line)))?;
        progress.finish_and_clear();
        console.print(&if common.json { json::hil(&report).to_string() } else { terminal::hil(&report) });
        Ok(conclude(report.failure.as_ref(), common.json, console))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::Command;
    use crate::cli::tests::parse;

    fn hil_args(arguments: &str) -> HilArgs {
        let cli = parse(&format!("host-sim hil a.img {arguments}")).unwrap();
        let Some(Command::Hil { hil, .. }) = cli.command else { panic!("not hil") };
        hil
    }

    #[test]
    fn a_board_is_emulated_or_behind_a_port() {
        let emulated = hil_args("--board virt --frames f --program p").place.place();
        assert_eq!(emulated, Place::Emulated { board: Board::Virt, program: Some("p".into()) });
        let port = hil_args("--port /dev/ttyACM0 --baud 1000000 --frames f").place.place();
        assert_eq!(port, Place::Port { device: "/dev/ttyACM0".into(), baud: 1_000_000 });
        for wrong in ["--frames f", "--board virt --port p --frames f", "--board m8 --frames f", "--board virt"] {
            assert!(parse(&format!("host-sim hil a.img {wrong}")).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_board_is_fed_from_one_place() {
        assert_eq!(hil_args("--board an386 --log l").feed.feed(), Feed::Log("l".into()));
        let source = FrameSource { frames: Some("f".into()), ..FrameSource::default() };
        assert_eq!(hil_args("--board an386 --frames f --crop").feed.feed(), Feed::Frames { source, crop: true });
        for wrong in ["--frames f --log l", "--inputs i --log l", "--log l --crop", "--log l --frames-limit 2"] {
            assert!(parse(&format!("host-sim hil a.img --board virt {wrong}")).is_err(), "{wrong}");
        }
    }
}
