//! The boards in QEMU: the firmware's own program on an emulated core, with an image in its memory.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

/// An emulated board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Board {
    /// Its package in `firmware/boards`.
    pub name: &'static str,
    /// Target of its core.
    triple: &'static str,
    emulator: &'static str,
    machine: &'static [&'static str],
    /// Where the program looks for the image.
    image_address: u32,
    /// By how much two equal counts of instructions may differ: the counter's tick may be no divisor of 64 ns.
    pub counter_resolution: u64,
}

/// Every board.
pub const ALL: [Board; 4] = [
    Board {
        name: "an386",
        triple: "thumbv7em-none-eabihf",
        emulator: "qemu-system-arm",
        machine: &["mps2-an386"],
        image_address: 0x2100_0000,
        counter_resolution: 1,
    },
    Board {
        name: "an500",
        triple: "thumbv7em-none-eabihf",
        emulator: "qemu-system-arm",
        machine: &["mps2-an500"],
        image_address: 0x6000_0000,
        counter_resolution: 1,
    },
    Board {
        name: "an547",
        triple: "thumbv8m.main-none-eabihf",
        emulator: "qemu-system-arm",
        machine: &["mps3-an547"],
        image_address: 0x6000_0000,
        counter_resolution: 0,
    },
    Board {
        name: "virt",
        triple: "aarch64-unknown-none",
        emulator: "qemu-system-aarch64",
        machine: &["virt", "-cpu", "cortex-a72", "-m", "512M", "-nic", "none"],
        image_address: 0x5000_0000,
        counter_resolution: 0,
    },
];

/// A board's binaries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Program {
    /// The product.
    Drive,
    /// Checks for bench and test.
    Check,
    /// The one in C (`firmware/boards/c`), of the first board alone.
    InC,
}

/// What a run gave.
#[derive(Clone, Debug)]
pub struct Run {
    /// Exit status of the program on the board.
    pub status: Option<i32>,
    /// What it wrote to its UART.
    pub console: String,
}

impl Board {
    /// Runs the self-test over an image; `None` as of [`Self::check`].
    ///
    /// # Panics
    /// As [`Self::check`].
    pub fn run(&self, image: &[u8]) -> Option<Run> {
        self.check("self-test", image)
    }

    /// Runs a check over an image and what lies behind it; `None` where the program or the emulator is missing, which
    /// is said past the test's capture.
    ///
    /// # Panics
    /// The image cannot be written or the emulator not started.
    pub fn check(&self, check: &str, memory: &[u8]) -> Option<Run> {
        self.run_program(Program::Check, check, memory)
    }

    /// Runs a program with a command line; as [`Self::check`].
    ///
    /// # Panics
    /// As [`Self::check`].
    pub fn run_program(&self, program: Program, command_line: &str, memory: &[u8]) -> Option<Run> {
        let program = self.built_program(program)?;
        let folder = tempfile::tempdir().expect("a temporary folder");
        let file = folder.path().join("model.img");
        fs::write(&file, memory).expect("the image");
        let output = Command::new(self.emulator)
            .arg("-M")
            .args(self.machine)
            .args(["-display", "none", "-monitor", "none", "-serial", "stdio", "-icount", "shift=6"])
            .args(["-semihosting-config", "enable=on,target=native", "-device"])
            .arg(format!("loader,file={},addr={:#x},force-raw=on", file.display(), self.image_address))
            .args(["-append", command_line, "-kernel"])
            .arg(program)
            .output()
            .unwrap_or_else(|e| panic!("{}: {e}", self.emulator));
        Some(Run { status: output.status.code(), console: String::from_utf8_lossy(&output.stdout).into_owned() })
    }

    /// A program of the board; `None` where it or the emulator is missing, which is said past the test's capture.
    pub fn built_program(&self, program: Program) -> Option<PathBuf> {
        let program = self.program(program);
        if program.exists() && is_installed(self.emulator) {
            return Some(program);
        }
        let _ = writeln!(
            std::io::stderr(),
            "not run: board {}; tests/run builds {} and installs {} (Debian's package qemu-system-arm)",
            self.name,
            program.display(),
            self.emulator
        );
        None
    }

    /// Where `tests/run` puts the ELF of a program.
    pub fn program(&self, program: Program) -> PathBuf {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let name = match program {
            Program::Drive => format!("{}-drive", self.name),
            Program::Check => format!("{}-check", self.name),
            Program::InC => format!("{}-c", self.name),
        };
        root.join("target/mcu").join(self.triple).join("release").join(name)
    }
}

fn is_installed(program: &str) -> bool {
    Command::new(program).arg("--version").output().is_ok_and(|output| output.status.success())
}
