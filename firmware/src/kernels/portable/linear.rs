//! Portable linear layer.

use super::codes::{Code, take, widen};
use super::product::{Product, TILE, Weights};
use crate::kernels::LinearArgs;
use crate::tensor::{Codes, CodesMut, index};

/// `acc = b' + Σ w·q` per position, then the epilogue.
///
/// `input`: i8 or i16, `positions × inputs`; `output`: i8 or i16, `positions × outputs`, which may hold the residual;
/// weights `[outputs][inputs]` in [−127, 127], packed. Accumulates in i32, with `wide` in i64. `scratch`:
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
        weights: Weights::new(args.kernel, args.weights, args.outputs, depth),
        depth,
        channels: 0..usize::from(args.outputs),
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
            let Some(buffer) = product.weights.buffer(&mut scratch, depth) else { return };
            for (i, codes) in input.chunks(tile_len).enumerate() {
                widen(codes, tile);
                product.tile(tile.get(..codes.len()).unwrap_or_default(), i * TILE, output, buffer);
            }
        }
        Codes::I16(input) => {
            let Some(buffer) = product.weights.buffer(&mut scratch, depth) else { return };
            for (i, rows) in input.chunks(tile_len).enumerate() {
                product.tile(rows, i * TILE, output, buffer);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::{Buffer, HOSTILE, RescaleConstants, Scratch, for_seeds, pack, rescale};
    use super::*;
    use crate::kernels::plan::linear_scratch_bytes;
    use crate::program::KernelId;
    use crate::tensor::ElementType;
    use std::vec::Vec;

    fn expected(args: &LinearArgs<'_>, input: &Buffer, residual: &Buffer) -> Vec<i128> {
        let (inputs, outputs) = (usize::from(args.inputs), usize::from(args.outputs));
        let code = |element: usize| {
            let (position, channel) = (element / outputs, element % outputs);
            let products =
                (0..inputs).map(|k| i128::from(args.weights[channel * inputs + k]) * input.get(position * inputs + k));
            let acc = i128::from(args.rescale.bias[channel]) + products.sum::<i128>();
            rescale(&args.rescale, channel, acc, residual.get(element))
        };
        (0..args.positions as usize * outputs).map(code).collect()
    }

    #[test]
    fn equals_the_naive_sum() {
        for_seeds(500, |rng| {
            let element_type = rng.element_type();
            let (positions, inputs, outputs) =
                (rng.range(1, 9) as u32, rng.range(1, 70) as u16, rng.range(1, 9) as u16);
            let code_bits = if element_type == ElementType::I8 { 8 } else { 16 };
            let constants = RescaleConstants::random(
                rng,
                usize::from(outputs),
                positions as usize * usize::from(outputs),
                code_bits + 9,
            );
            let input = rng.buffer(element_type, positions as usize * usize::from(inputs));
            let weights: Vec<i8> = rng.values(usize::from(inputs) * usize::from(outputs), -127, 127);
            let wide = rng.flag();
            let rescale = constants.args();
            let kernel = KernelId::Direct;
            let args = LinearArgs { positions, inputs, outputs, kernel, weights: &weights, wide, rescale };
            let expected = expected(&args, &input, &constants.residual_buffer);
            for kernel in KernelId::ALL {
                let packed = pack(*kernel, &weights, 1, outputs, inputs.into());
                let args = LinearArgs { kernel: *kernel, weights: &packed, ..args };
                let mut output = constants.initial_output(rng);
                let mut scratch = Scratch::new(linear_scratch_bytes(*kernel, positions, inputs, element_type));
                linear(&args, input.codes(), output.codes_mut(), scratch.bytes());
                output.assert_equals(&expected, &std::format!("{kernel:?} linear"));
            }
        });
    }

    #[test]
    fn wide_sums_exceed_32_bits() {
        // 1023 · 127 · 32767 is a little below 2^32.
        let constants = (std::vec![0], std::vec![1 << 23], std::vec![40u8]);
        let rescale = crate::kernels::RescaleArgs {
            pre_shift: 4,
            bias: &constants.0,
            multipliers: &constants.1,
            shifts: &constants.2,
            zero_point: 0,
            clamp: super::super::oracle::FULL,
            residual: crate::kernels::ResidualArgs::None,
        };
        let kernel = KernelId::Direct;
        let weights = [127; 1023];
        let args =
            LinearArgs { positions: 1, inputs: 1023, outputs: 1, kernel, weights: &weights, wide: true, rescale };
        let mut output = [0];
        linear(&args, Codes::I16(&[32767; 1023]), CodesMut::I16(&mut output), &mut []);
        assert_eq!(i64::from(output[0]), (1023 * 127 * 32767 + (1 << 20)) >> 21);
    }

    #[test]
    fn hostile_constants_and_lengths_do_not_panic() {
        let kernel = KernelId::Direct;
        let weights = [-128; 600];
        for (positions, inputs, outputs) in
            [(2, 300, 2), (1, 600, 1), (0, 3, 1), (3, 0, 0), (u32::MAX, u16::MAX, u16::MAX)]
        {
            for wide in [false, true] {
                let args = LinearArgs { positions, inputs, outputs, kernel, weights: &weights, wide, rescale: HOSTILE };
                let mut scratch = Scratch::new(9600);
                linear(&args, Codes::I16(&[i16::MIN; 600]), CodesMut::I16(&mut [i16::MIN; 4]), &mut []);
                linear(&args, Codes::I8(&[i8::MIN; 600]), CodesMut::I8(&mut [i8::MIN; 4]), scratch.bytes());
                linear(&args, Codes::I8(&[]), CodesMut::I8(&mut [i8::MIN; 1]), &mut []);
            }
        }
    }
}
