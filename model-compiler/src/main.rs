//! The command line of the model compiler; see [`model_compiler::cli`].
#![forbid(unsafe_code)]

use model_compiler::cli::{self, Console};
use std::process::ExitCode;

fn main() -> ExitCode {
    let console = Console { out: &mut std::io::stdout(), err: &mut std::io::stderr() };
    ExitCode::from(cli::main(std::env::args_os(), console))
}
