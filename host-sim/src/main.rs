//! The command line; see [`host_sim::cli`].
#![forbid(unsafe_code)]

use host_sim::cli::{self, Console};
use std::process::ExitCode;

fn main() -> ExitCode {
    let console = Console { out: &mut std::io::stdout(), err: &mut std::io::stderr() };
    ExitCode::from(cli::main(std::env::args_os(), console))
}
