//! Portable linear layer.

use super::codes::{Code, take, widen};
use super::product::{Product, TILE};
use crate::kernels::LinearArgs;
use crate::tensor::{Codes, CodesMut, index};

/// `acc = b' + Σ w·q` per position, then the epilogue.
///
/// `input`: i8 or i16, `positions × inputs`; `output`: i8 or i16, `positions × outputs`, which may hold the residual;
/// weights `[outputs][inputs]` in [−127, 127]. Accumulates in i32, with `wide` in i64. `scratch`:
/// [`crate::kernels::plan::linear_scratch_bytes`], aligned to 2 bytes.
pub fn linear(args: &LinearArgs<'_>, input: Codes<'_>, output: CodesMut<'_>, scratch: &mut [u8]) {
    match output {
        CodesMut::I8(output) => run(args, input, output, scratch),
        CodesMut::I16(output) => run(args, input, output, scratch),
    }
}

fn run<T: Code>(args: &LinearArgs<'_>, input: Codes<'_>, output: &mut [T], mut scratch: &mut [u8]) {
    let (positions, depth) = (index(args.positions), usize::from(args.inputs));
    let product = Product {
        weights: args.weights,
        depth,
        first_channel: 0,
        outputs: usize::from(args.outputs),
        rescale: &args.rescale,
        wide: args.wide,
    };
    let tile_len = TILE.min(positions).saturating_mul(depth);
    if tile_len == 0 || Some(output.len()) != positions.checked_mul(product.outputs) {
        return;
    }
    match input {
        Codes::I8(input) => {
            let Some(tile) = take::<i16>(&mut scratch, tile_len) else { return };
            for (i, codes) in input.chunks(tile_len).enumerate() {
                widen(codes, tile);
                product.tile(tile.get(..codes.len()).unwrap_or_default(), i * TILE, output);
            }
        }
        Codes::I16(input) => {
            for (i, rows) in input.chunks(tile_len).enumerate() {
                product.tile(rows, i * TILE, output);
            }
        }
    }
}
