//! What the kernels need, as pure functions shared with the compiler: scratch sizes and in-place rules.

use super::portable::Axis;
use crate::program::{KernelId, Window};
use crate::tensor::{ElementType, Shape};

/// Rows (output pixels, positions) that the portable product works on at once.
pub const TILE_ROWS: u32 = 4;

/// Scratch of a convolution, bytes: the windows of up to [`TILE_ROWS`] output pixels in one group, widened to `i16`.
pub const fn conv2d_scratch_bytes(kernel: KernelId, input: Shape, output: Shape, window: Window, groups: u16) -> u32 {
    let KernelId::Direct = kernel;
    if groups == 0 {
        return 0;
    }
    let depth = window.kernel_h as u64 * window.kernel_w as u64 * (input.channels / groups) as u64;
    let positions = output.positions();
    let rows = if positions < TILE_ROWS { positions } else { TILE_ROWS };
    saturate(2 * rows as u64 * depth)
}

/// Scratch of a linear layer, bytes: [`TILE_ROWS`] rows of an `i8` input, widened to `i16`; none for `i16` input.
pub const fn linear_scratch_bytes(kernel: KernelId, inputs: u16, outputs: u16, input: ElementType) -> u32 {
    let KernelId::Direct = kernel;
    let _ = outputs;
    match input {
        ElementType::I8 => 2 * TILE_ROWS * inputs as u32,
        ElementType::I16 | ElementType::I32 | ElementType::Scratch => 0,
    }
}

/// Scratch of attention, bytes: for one query row of one head the logits (`i32`, one per key), the context sums
/// (`i32`, one per channel of the head) and the widened query (`i16`).
pub const fn attention_scratch_bytes(tokens: u32, channels: u16, heads: u16) -> u32 {
    if heads == 0 {
        return 0;
    }
    saturate(4 * tokens as u64 + 6 * (channels / heads) as u64)
}

/// Scratch of the waypoint decoder, bytes: two hidden states of `i16`.
pub const fn waypoint_decoder_scratch_bytes(hidden_size: u16) -> u32 {
    4 * hidden_size as u32
}

/// Whether a max pool may write its output over the front of its input: in raster order no output element may land on
/// an input element that a later output still reads.
///
/// Output pixel `(y, x)` is written when `y·W_out + x` pixels have been; so its window must not begin before input pixel
/// `y·W_out + x`. (An element may land on one that its own window reads: the kernel reads first.)
pub fn max_pool_in_place(input: Shape, output: Shape, window: Window) -> bool {
    if input.channels != output.channels || output.elements() > input.elements() {
        return false;
    }
    let (rows, columns) = (Axis::rows(&window, input), Axis::columns(&window, input));
    let lead = |axis: Axis, index: u16| axis.taps(usize::from(index)).next();
    // The column that is furthest behind decides: the least of first tap − x.
    let Some(column_lead) = (0..output.width).filter_map(|x| Some(signed(lead(columns, x)?) - i64::from(x))).min()
    else {
        return true; // no window reads anything
    };
    (0..output.height).all(|y| {
        let Some(first_row) = lead(rows, y) else { return true };
        let written = i64::from(y) * i64::from(output.width);
        signed(first_row) * i64::from(input.width) + column_lead >= written
    })
}

/// An index below 2^16 + 2^8, signed.
fn signed(index: usize) -> i64 {
    i64::try_from(index).unwrap_or(i64::MAX)
}

const fn saturate(bytes: u64) -> u32 {
    if bytes > u32::MAX as u64 { u32::MAX } else { bytes as u32 }
}
