//! The command line of the model compiler.
#![forbid(unsafe_code)]

use clap::Parser;
use model_compiler::cli::Cli;
use std::process::ExitCode;

fn main() -> ExitCode {
    match Cli::parse().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(error.code.exit_status())
        }
    }
}
