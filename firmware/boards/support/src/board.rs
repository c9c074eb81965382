//! A board as a program is given it.

use crate::machine::Machine;

/// What a board hands to a program.
#[derive(Debug)]
pub struct Board<U, C, K> {
    /// Console and time.
    pub machine: Machine<U, C>,
    /// The model image, as its memory holds it; nothing of it is checked.
    pub image: &'static [u8],
    /// The memory behind it.
    pub behind: &'static [u8],
    /// Backend of the board's core.
    pub kernels: K,
    /// Memory for the engine.
    pub arena: &'static mut [u8],
}
