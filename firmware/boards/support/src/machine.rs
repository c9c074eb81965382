//! What a program sees of a board.

use crate::counter::Counter;
use crate::uart::Uart;
use core::fmt::{self, Write};

/// A board as a program sees it.
#[derive(Debug)]
pub struct Machine<U, C> {
    /// Name for messages.
    pub name: &'static str,
    /// Console and link.
    pub uart: U,
    /// Time.
    pub counter: C,
}

/// Text goes to the UART.
impl<U: Uart, C: Counter> fmt::Write for Machine<U, C> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        text.bytes().for_each(|byte| self.uart.send(byte));
        Ok(())
    }
}

/// Prints an error of a program.
///
/// # Errors
/// [`fmt::Error`], which the program ends with.
pub fn say<U: Uart, C: Counter, T, E: fmt::Display>(
    machine: &mut Machine<U, C>,
    result: Result<T, E>,
) -> Result<T, fmt::Error> {
    result.map_err(|error| {
        let board = machine.name;
        let _ = writeln!(machine, "{board}: {error}");
        fmt::Error
    })
}
