//! What the kernels need, as pure functions shared with the compiler: scratch sizes and in-place rules.

use crate::program::{KernelId, Window};
use crate::tensor::{ElementType, Shape};

/// Scratch of a convolution, bytes.
pub const fn conv2d_scratch_bytes(kernel: KernelId, input: Shape, output: Shape, window: Window, groups: u16) -> u32 {
    let _ = (kernel, input, output, window, groups);
    0
}

/// Scratch of a linear layer, bytes.
pub const fn linear_scratch_bytes(kernel: KernelId, inputs: u16, outputs: u16, input: ElementType) -> u32 {
    let _ = (kernel, inputs, outputs, input);
    0
}

/// Scratch of attention, bytes.
pub const fn attention_scratch_bytes(tokens: u32, channels: u16, heads: u16) -> u32 {
    let _ = (tokens, channels, heads);
    0
}

/// Scratch of the waypoint decoder, bytes.
pub const fn waypoint_decoder_scratch_bytes(hidden_size: u16) -> u32 {
    let _ = hidden_size;
    0
}

/// Whether a max pool may write its output over the front of its input: in raster order no output element may land on
/// an input element that a later output still reads.
pub fn max_pool_in_place(input: Shape, output: Shape, window: Window) -> bool {
    let _ = (input, output, window);
    false
}
