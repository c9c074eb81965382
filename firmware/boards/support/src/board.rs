//! A board as a program is given it.

use crate::image_memory::ImageMemory;
use crate::machine::Machine;

/// What a board hands to a program.
#[derive(Debug)]
pub struct Board<U, C, K> {
    /// Console or link, and time.
    pub machine: Machine<U, C>,
    /// Where model images lie.
    pub images: ImageMemory,
    /// Name of the target that images for this board are compiled for.
    pub target: &'static str,
    /// Backend of the board's core.
    pub kernels: K,
    /// Memory for the engine.
    pub arena: &'static mut [u8],
}

/// A board on the bench: it runs the image that lies there, whatever it was compiled for.
#[derive(Debug)]
pub struct Bench<U, C, K> {
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

impl<U, C, K> Board<U, C, K> {
    /// The board with the image that lies at the start of its memory.
    pub fn bench(self) -> Bench<U, C, K> {
        let Self { machine, images, kernels, arena, .. } = self;
        let (image, behind) = images.stored();
        Bench { machine, image, behind, kernels, arena }
    }
}
