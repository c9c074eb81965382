//! What the kernels need, as pure functions shared with the compiler: choice of kernels, sizes of packed weights and
//! scratch, in-place rules.

use super::k4n16;
use super::portable::Axis;
use crate::program::{KernelId, Window};
use crate::tensor::{ElementType, Shape};

/// Rows (output pixels, positions) that the portable product works on at once.
pub const TILE_ROWS: u32 = 4;

/// Rows that the kernels of [`KernelId::K4N16`] work on at once.
pub const PACKED_TILE_ROWS: u32 = 6;

/// Most scratch that a step of [`KernelId::K4N16`] asks for, unless a single tile needs more: it and the weights that
/// meet it stay in a second-level cache of 1 MiB.
const PACKED_SCRATCH_BYTES: u64 = 384 << 10;

/// Whether a weighted step gains by a kernel: blocks of 16 outputs want groups that fill them. (Every kernel can run
/// every step.)
pub const fn suits(kernel: KernelId, groups: u16, outputs: u16) -> bool {
    match kernel {
        KernelId::Direct => true,
        KernelId::K4N16 => groups == 1 || (groups != 0 && ((outputs / groups) as usize).is_multiple_of(k4n16::OUTPUTS)),
    }
}

/// Bytes of packed weights: `outputs` output channels in `groups` groups, with `depth` weights each.
pub const fn weight_bytes(kernel: KernelId, groups: u16, outputs: u16, depth: u64) -> u64 {
    match kernel {
        KernelId::Direct => (outputs as u64).saturating_mul(depth),
        KernelId::K4N16 if groups == 0 => 0,
        KernelId::K4N16 => k4n16::packed_bytes(groups, outputs / groups, depth),
    }
}

/// Scratch of a convolution, bytes. [`KernelId::Direct`]: the windows of up to [`TILE_ROWS`] output pixels in one
/// group, widened to `i16`. [`KernelId::K4N16`]: the same for as many tiles as fit the cache.
pub const fn conv2d_scratch_bytes(kernel: KernelId, input: Shape, output: Shape, window: Window, groups: u16) -> u32 {
    if groups == 0 {
        return 0;
    }
    let depth = window.kernel_h as u64 * window.kernel_w as u64 * (input.channels / groups) as u64;
    let positions = output.positions();
    match kernel {
        KernelId::Direct => {
            let rows = if positions < TILE_ROWS { positions } else { TILE_ROWS };
            saturate(2 * rows as u64 * depth)
        }
        KernelId::K4N16 => packed_scratch_bytes(depth, positions),
    }
}

/// Scratch of a linear layer, bytes. [`KernelId::Direct`]: [`TILE_ROWS`] rows of an `i8` input, widened to `i16`; none
/// for `i16` input. [`KernelId::K4N16`]: as for a convolution.
pub const fn linear_scratch_bytes(kernel: KernelId, positions: u32, inputs: u16, input: ElementType) -> u32 {
    match (kernel, input) {
        (KernelId::Direct, ElementType::I8) => 2 * TILE_ROWS * inputs as u32,
        (KernelId::Direct, ElementType::I16 | ElementType::I32 | ElementType::Scratch) => 0,
        (KernelId::K4N16, _) => packed_scratch_bytes(inputs as u64, positions),
    }
}

/// Bytes from one row of `length` bytes in scratch to the next: an odd number of cache lines, so that the rows of a
/// tile never compete for the same set of a cache.
pub const fn row_stride_bytes(length: u64) -> u64 {
    (length.div_ceil(64) | 1).saturating_mul(64)
}

/// Tiles of `i16` rows; a tile also has room for the portable kernel's rows and the weights of one output.
const fn packed_scratch_bytes(depth: u64, positions: u32) -> u32 {
    let tile = (PACKED_TILE_ROWS as u64).saturating_mul(row_stride_bytes(depth.saturating_mul(2)));
    let (wanted, fitting) = (positions.div_ceil(PACKED_TILE_ROWS) as u64, PACKED_SCRATCH_BYTES / tile);
    let tiles = if wanted < fitting { wanted } else { fitting };
    saturate(tile.saturating_mul(if tiles == 0 { 1 } else { tiles }))
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
/// Output pixel `(y, x)` is written when `y·W_out + x` pixels have been; so its window must not begin before input
/// pixel `y·W_out + x`. (An element may land on one that its own window reads: the kernel reads first.)
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Simulates the raster order: output pixel i overwrites input pixel i; is a pixel ever read after that?
    fn never_reads_overwritten(input: Shape, output: Shape, window: Window) -> bool {
        let axis = |out: u16, tap: u8, stride: u8, dilation: u8, pad: u8, size: u16| {
            let at = i32::from(out) * i32::from(stride) + i32::from(tap) * i32::from(dilation) - i32::from(pad);
            (0..i32::from(size)).contains(&at).then_some(at)
        };
        let mut written = 0;
        for y in 0..output.height {
            for x in 0..output.width {
                for ky in 0..window.kernel_h {
                    for kx in 0..window.kernel_w {
                        let row = axis(y, ky, window.stride_h, window.dilation_h, window.pad_top, input.height);
                        let column = axis(x, kx, window.stride_w, window.dilation_w, window.pad_left, input.width);
                        if let (Some(row), Some(column)) = (row, column)
                            && row * i32::from(input.width) + column < written
                        {
                            return false;
                        }
                    }
                }
                written += 1;
            }
        }
        output.elements() <= input.elements()
    }

    #[test]
    fn max_pool_in_place_equals_a_simulation() {
        let (mut allowed, mut forbidden) = (0, 0);
        let digits = |code: u32| [code % 3, code / 3 % 3, code / 9 % 3, code / 27 % 3].map(|d| d as u8);
        for code in 0..81 * 27 {
            let [kernel_h, kernel_w, stride_h, stride_w] = digits(code % 81).map(|d| d + 1);
            let [pad_top, pad_left, dilation, _] = digits(code / 81);
            let window = Window {
                kernel_h,
                kernel_w,
                stride_h,
                stride_w,
                pad_top,
                pad_bottom: pad_top,
                pad_left,
                pad_right: pad_left.saturating_sub(1),
                dilation_h: dilation + 1,
                dilation_w: 1 + dilation % 2,
            };
            for (height, width) in [(1, 1), (1, 5), (4, 1), (2, 3), (3, 2), (5, 4), (4, 7)] {
                let Some((out_height, out_width)) = window.output_size(height, width) else { continue };
                let (input, output) = (Shape::map(height, width, 2), Shape::map(out_height, out_width, 2));
                let expected = never_reads_overwritten(input, output, window);
                assert_eq!(max_pool_in_place(input, output, window), expected, "{input:?} {window:?}");
                *(if expected { &mut allowed } else { &mut forbidden }) += 1;
            }
        }
        assert!(allowed > 1000 && forbidden > 1000, "{allowed} allowed, {forbidden} forbidden");
    }

    #[test]
    fn transfusers_stem_pool_may_run_in_place() {
        let window = Window::square(3, 2, 1);
        assert!(max_pool_in_place(Shape::map(128, 128, 64), Shape::map(64, 64, 64), window));
        assert!(!max_pool_in_place(Shape::map(128, 128, 64), Shape::map(64, 64, 32), window), "channels differ");
    }

    #[test]
    fn blocks_want_groups_that_fill_them() {
        assert!(suits(KernelId::K4N16, 1, 3) && suits(KernelId::K4N16, 2, 64));
        assert!(!suits(KernelId::K4N16, 2, 48) && !suits(KernelId::K4N16, 64, 64) && !suits(KernelId::K4N16, 0, 64));
        assert!(suits(KernelId::Direct, 64, 64));
        assert_eq!(weight_bytes(KernelId::Direct, 2, 16, 9), 144);
        assert_eq!(weight_bytes(KernelId::K4N16, 2, 34, 9), 4 * (64 + 16 * 64));
    }

    #[test]
    fn packed_scratch_holds_whole_tiles_within_the_cache() {
        let three = Window::square(3, 1, 1);
        let scratch = |side, channels| {
            let shape = Shape::map(side, side, channels);
            conv2d_scratch_bytes(KernelId::K4N16, shape, shape, three, 1)
        };
        assert_eq!(scratch(2, 64), 6 * 19 * 64, "four pixels are one tile");
        let tile = 6 * 145 * 64;
        assert_eq!(scratch(8, 512), 7 * tile);
        assert!(scratch(64, 64) <= 384 << 10);
    }

    #[test]
    fn scratch_of_hostile_shapes_is_a_number() {
        let all = Shape::map(u16::MAX, u16::MAX, u16::MAX);
        let window = Window {
            kernel_h: 255,
            kernel_w: 255,
            stride_h: 0,
            stride_w: 0,
            pad_top: 255,
            pad_bottom: 255,
            pad_left: 255,
            pad_right: 255,
            dilation_h: 255,
            dilation_w: 255,
        };
        assert_eq!(conv2d_scratch_bytes(KernelId::Direct, all, all, window, 1), u32::MAX);
        assert_eq!(conv2d_scratch_bytes(KernelId::Direct, all, all, window, 0), 0);
        assert_eq!(attention_scratch_bytes(u32::MAX, u16::MAX, 1), u32::MAX);
        assert_eq!(attention_scratch_bytes(1, 1, 0), 0);
        assert_eq!(linear_scratch_bytes(KernelId::Direct, 1, u16::MAX, ElementType::I8), 8 * 65535);
        assert_eq!(conv2d_scratch_bytes(KernelId::K4N16, all, all, window, 1), u32::MAX);
        assert_eq!(linear_scratch_bytes(KernelId::K4N16, u32::MAX, u16::MAX, ElementType::I16), 6 * 64 * 2049);
        assert_eq!(linear_scratch_bytes(KernelId::K4N16, 0, 0, ElementType::I8), 6 * 64);
        assert_eq!(waypoint_decoder_scratch_bytes(u16::MAX), 4 * 65535);
        assert!(!max_pool_in_place(all, all, Window { stride_h: 0, ..window }));
    }
}
