//! What a program sees of a board.

use crate::counter::Counter;
use crate::uart::Uart;
use core::fmt;

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
