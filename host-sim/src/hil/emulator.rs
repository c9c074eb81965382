//! The boards of `firmware/boards` in QEMU: the machine, the board's program, and the image in its memory.

use super::line::Line;
use model_compiler::error::{Error, ErrorCode, Result};
use std::io::{ErrorKind, Read};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};
use tempfile::NamedTempFile;

/// What the boards' program that answers requests is called behind the board's name.
const PROGRAM: &str = "drive";
/// Nanoseconds of virtual time per instruction under `-icount shift=6`: clocks count instructions exactly.
const NANOSECONDS_PER_INSTRUCTION: u64 = 64;
/// How long the emulator has to connect to its line; it does so before it runs anything.
const CONNECTION: Duration = Duration::from_secs(60);
/// How often a wait for the end looks.
const GLANCE: Duration = Duration::from_millis(20);

/// An emulated board.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Board {
    /// Cortex-M4F on Arm's MPS2 board.
    An386,
    /// Cortex-M7 on Arm's MPS2 board.
    An500,
    /// Cortex-M55 on Arm's MPS3 board.
    An547,
    /// Cortex-A72 on QEMU's own board.
    Virt,
}

impl Board {
    /// Every board.
    pub const ALL: [Self; 4] = [Self::An386, Self::An500, Self::An547, Self::Virt];

    /// Its package in `firmware/boards`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::An386 => "an386",
            Self::An500 => "an500",
            Self::An547 => "an547",
            Self::Virt => "virt",
        }
    }

    /// Target of its core.
    pub const fn triple(self) -> &'static str {
        match self {
            Self::An386 | Self::An500 => "thumbv7em-none-eabihf",
            Self::An547 => "thumbv8m.main-none-eabihf",
            Self::Virt => "aarch64-unknown-none",
        }
    }

    /// Name of the target that images for it are compiled for.
    pub const fn target(self) -> &'static str {
        match self {
            Self::An386 => "cortex-m4",
            Self::An500 => "cortex-m7",
            Self::An547 => "cortex-m55",
            Self::Virt => "cortex-a",
        }
    }

    /// The emulator of its core.
    pub const fn emulator(self) -> &'static str {
        match self {
            Self::An386 | Self::An500 | Self::An547 => "qemu-system-arm",
            Self::Virt => "qemu-system-aarch64",
        }
    }

    /// The emulator's name for the machine, and what belongs to it.
    const fn machine(self) -> &'static [&'static str] {
        match self {
            Self::An386 => &["mps2-an386"],
            Self::An500 => &["mps2-an500"],
            Self::An547 => &["mps3-an547"],
            Self::Virt => &["virt", "-cpu", "cortex-a72", "-m", "512M", "-nic", "none"],
        }
    }

    /// Where the program looks for the image.
    const fn image_address(self) -> u32 {
        match self {
            Self::An386 => 0x2100_0000,
            Self::An500 | Self::An547 => 0x6000_0000,
            Self::Virt => 0x5000_0000,
        }
    }

    /// The board's program as a build of this source tree leaves it.
    pub fn program(self) -> PathBuf {
        let crate_folder = Path::new(env!("CARGO_MANIFEST_DIR"));
        let root = crate_folder.parent().unwrap_or(crate_folder);
        root.join("target/mcu").join(self.triple()).join("release").join(format!("{}-{PROGRAM}", self.name()))
    }

    fn no_program(self, path: &Path) -> Error {
        let (name, triple) = (self.name(), self.triple());
        Error::new(ErrorCode::Io, path.display().to_string(), format!("the program of board {name} is not there"))
            .with_help(format!(
                "build it in firmware/boards/{name}: CARGO_TARGET_DIR=../../../target/mcu cargo build --release \
                 --target {triple} (tests/run does), or name another with --program"
            ))
    }

    fn no_emulator(self, error: &std::io::Error) -> Error {
        Error::new(ErrorCode::Io, self.emulator(), format!("the emulator does not start: {error}"))
            .with_help("install QEMU: Debian's and Ubuntu's package is qemu-system-arm, Homebrew's is qemu")
    }
}

/// Instructions that so many ticks of a clock stand for.
pub fn instructions(ticks: u64, hertz: u64) -> u64 {
    let unit = u128::from(hertz) * u128::from(NANOSECONDS_PER_INSTRUCTION);
    let instructions = (u128::from(ticks) * 1_000_000_000 + unit / 2).checked_div(unit).unwrap_or(0);
    u64::try_from(instructions).unwrap_or(u64::MAX)
}

/// A running emulator; it ends with this value.
#[derive(Debug)]
pub struct Emulator {
    board: Board,
    child: Child,
    errors: Option<JoinHandle<String>>,
    log: NamedTempFile,
    program: PathBuf,
}

impl Emulator {
    /// Starts a board with an image in its memory: the emulator, and the line to its UART, a connection within this
    /// machine. What the program writes by semihosting comes from the emulator's own output and goes to a file.
    ///
    /// # Errors
    /// Program or emulator is missing.
    pub fn start(board: Board, program: Option<&Path>, image: &Path) -> Result<(Self, Line)> {
        let program = program.map_or_else(|| board.program(), Path::to_path_buf);
        if !program.is_file() {
            return Err(board.no_program(&program));
        }
        let temporary = |e| Error::io(&std::env::temp_dir(), &e);
        let log = NamedTempFile::new().map_err(temporary)?;
        let output = log.reopen().map_err(temporary)?;
        let no_line = |e: std::io::Error| Error::new(ErrorCode::Link, board.name(), format!("no line: {e}"));
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).map_err(no_line)?;
        let port = listener.local_addr().map_err(no_line)?.port();
        let mut child = Command::new(board.emulator())
            .arg("-M")
            .args(board.machine())
            .args(["-display", "none", "-monitor", "none", "-icount", "shift=6", "-device"])
            .arg(format!("loader,file={},addr={:#x},force-raw=on", escaped(image), board.image_address()))
            .args(["-semihosting-config", "enable=on,target=native", "-serial", "chardev:line", "-chardev"])
            .arg(format!("socket,id=line,host=127.0.0.1,port={port},nodelay=on"))
            .arg("-kernel")
            .arg(&program)
            .stdin(Stdio::null())
            .stdout(output)
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|e| board.no_emulator(&e))?;
        let errors = child.stderr.take();
        let mut emulator = Self { board, child, errors: None, log, program };
        let Some(mut errors) = errors else {
            return Err(Error::new(ErrorCode::Link, board.name(), "the emulator has no streams"));
        };
        emulator.errors = Some(thread::spawn(move || {
            let mut text = Vec::new();
            // What was said until then is told.
            let _ = errors.read_to_end(&mut text);
            String::from_utf8_lossy(&text).into_owned()
        }));
        let from_board = emulator.connection(&listener)?;
        let to_board = from_board.try_clone().map_err(no_line)?;
        Ok((emulator, Line::new(board.name(), from_board, to_board)))
    }

    /// The emulator's connection to the line.
    fn connection(&mut self, listener: &TcpListener) -> Result<TcpStream> {
        let name = self.board.name();
        let failed = |e: std::io::Error| Error::new(ErrorCode::Link, name, format!("no line: {e}"));
        listener.set_nonblocking(true).map_err(failed)?;
        let begin = Instant::now();
        loop {
            match listener.accept() {
                Ok((stream, _)) => {
                    stream.set_nonblocking(false).map_err(failed)?;
                    stream.set_nodelay(true).map_err(failed)?;
                    stream.set_read_timeout(Some(GLANCE)).map_err(failed)?;
                    return Ok(stream);
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock && begin.elapsed() < CONNECTION => {}
                Err(error) => return Err(failed(error)),
            }
            if let Some(status) = self.wait(GLANCE) {
                return Err(self.ended(status));
            }
        }
    }

    /// The program that runs on the board.
    pub fn program(&self) -> &Path {
        &self.program
    }

    /// Waits for the program's own end.
    ///
    /// # Errors
    /// It does not end in time, or ends with a failure.
    pub fn finish(&mut self, timeout: Duration) -> Result<()> {
        match self.wait(timeout) {
            Some(status) if status.success() => Ok(()),
            Some(status) => Err(self.ended(status)),
            None => {
                let message = format!("the emulator did not end within {} s", timeout.as_secs());
                Err(Error::new(ErrorCode::Link, self.board.name(), message))
            }
        }
    }

    /// What really happened, where the line failed because the emulator ended.
    pub fn explain(&mut self, error: Error) -> Error {
        if error.code != ErrorCode::Link {
            return error;
        }
        self.wait(10 * GLANCE).map_or(error, |status| self.ended(status))
    }

    /// What the program wrote by semihosting so far.
    ///
    /// # Errors
    /// The file is gone.
    pub fn log(&self) -> Result<Vec<u8>> {
        std::fs::read(self.log.path()).map_err(|e| Error::io(self.log.path(), &e))
    }

    fn wait(&mut self, timeout: Duration) -> Option<ExitStatus> {
        let begin = Instant::now();
        loop {
            match self.child.try_wait() {
                Ok(None) if begin.elapsed() < timeout => thread::sleep(GLANCE),
                Ok(status) => return status,
                Err(_) => return None,
            }
        }
    }

    fn ended(&mut self, status: ExitStatus) -> Error {
        let said = self.errors.take().and_then(|errors| errors.join().ok()).unwrap_or_default();
        let said = said.trim();
        let colon = if said.is_empty() { "" } else { ": " };
        let message = format!("{} ended with {status}{colon}{said}", self.board.emulator());
        Error::new(ErrorCode::Link, self.board.name(), message)
            .with_help("does the image fit the board's memory (firmware/boards/README.md), and is the program its own?")
    }
}

impl Drop for Emulator {
    fn drop(&mut self) {
        // Whatever it is doing: it is ours, and it ends. One that has ended already cannot be killed.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A path in an option of the emulator, where a comma ends a value unless it is doubled.
fn escaped(path: &Path) -> String {
    path.display().to_string().replace(',', ",,")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_become_instructions_to_the_nearest() {
        // 25 MHz: 40 ns per tick, 64 ns per instruction.
        assert_eq!([0, 1, 2, 8, 16].map(|ticks| instructions(ticks, 25_000_000)), [0, 1, 1, 5, 10]);
        assert_eq!(instructions(u64::MAX, 1), u64::MAX);
        assert_eq!(instructions(5, 0), 0);
    }

    #[test]
    fn a_missing_program_says_how_to_build_it() {
        let path = Path::new("/nowhere/virt-drive");
        let error = Emulator::start(Board::Virt, Some(path), Path::new("a.img")).unwrap_err();
        assert_eq!((error.location.as_str(), error.code.exit_status()), ("/nowhere/virt-drive", 2));
        assert!(error.help.contains("--target aarch64-unknown-none"), "{error}");
    }

    #[test]
    fn commas_in_paths_are_doubled() {
        assert_eq!(escaped(Path::new("a,b/c")), "a,,b/c");
    }
}
