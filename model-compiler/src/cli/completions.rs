//! Completion of commands and options in a shell.

use clap::{Args, CommandFactory};
use clap_complete::Shell;

/// Which shell.
#[derive(Clone, Copy, Debug, Args)]
pub struct CompletionArgs {
    /// Shell.
    #[arg(value_enum)]
    shell: Shell,
}

impl CompletionArgs {
    /// The script that the shell has to read.
    pub fn script<P: CommandFactory>(self) -> String {
        let mut program = P::command();
        let name = program.get_name().to_owned();
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut program, name, &mut script);
        String::from_utf8_lossy(&script).into_owned()
    }
}
