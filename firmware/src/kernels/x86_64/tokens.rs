//! Tokens for AVX2 and AVX-512: [`portable::tokens`] with the channels of a token in vectors.

use super::pool::offset;
use super::sums::{Aligned, BLOCK, Ending, add_codes};
use crate::kernels::portable::codes::{Code, block, block_mut};
use crate::kernels::{TokenSourceArgs, TokensArgs};
use crate::tensor::{Codes, CodesMut};

#[cfg(doc)]
use crate::kernels::portable;

/// [`portable::tokens::tokens`] with AVX2.
#[target_feature(enable = "avx2")]
pub(super) fn avx2(args: &TokensArgs<'_>, output: CodesMut<'_>) {
    tokens(args, output);
}

/// [`portable::tokens::tokens`] with AVX-512.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
pub(super) fn avx512(args: &TokensArgs<'_>, output: CodesMut<'_>) {
    tokens(args, output);
}

#[inline(always)]
fn tokens(args: &TokensArgs<'_>, output: CodesMut<'_>) {
    match output {
        CodesMut::I8(output) => run(args, output),
        CodesMut::I16(output) => run(args, output),
    }
}

#[inline(always)]
fn run<T: Code>(args: &TokensArgs<'_>, output: &mut [T]) {
    let mut first_token = 0;
    for source in &args.sources {
        first_token += match source.codes {
            Codes::I8(codes) => pool(args, source, codes, first_token, output),
            Codes::I16(codes) => pool(args, source, codes, first_token, output),
        };
    }
}

/// Writes the tokens of one source from `first_token` on and returns their number.
#[inline(always)]
fn pool<I: Code, O: Code>(
    args: &TokensArgs<'_>,
    source: &TokenSourceArgs<'_>,
    codes: &[I],
    first_token: usize,
    output: &mut [O],
) -> usize {
    let [pool_h, pool_w] = source.pool.map(usize::from);
    let (width, channels) = (usize::from(source.shape.width), usize::from(source.shape.channels));
    let (Some(grid_h), Some(grid_w)) =
        (usize::from(source.shape.height).checked_div(pool_h), width.checked_div(pool_w))
    else {
        return 0;
    };
    if source.shape.elements() != codes.len() as u64 {
        return 0;
    }
    let ending = Ending::of_sum(&args.sum);
    let offset = offset(pool_h * pool_w, source.zero_point);
    for (ty, tx) in (0..grid_h).flat_map(|ty| (0..grid_w).map(move |tx| (ty, tx))) {
        let token = first_token + ty * grid_w + tx;
        let (Some(row), Some(position)) = (block_mut(output, token, channels), block(args.position, token, channels))
        else {
            return 0;
        };
        let cells = (ty * pool_h..(ty + 1) * pool_h)
            .flat_map(|y| (tx * pool_w..(tx + 1) * pool_w).map(move |x| y * width + x))
            .filter_map(|cell| block(codes, cell, channels));
        for ((i, row), position) in row.chunks_mut(BLOCK).enumerate().zip(position.chunks(BLOCK)) {
            let mut sums = Aligned([0_i32; BLOCK]);
            for cell in cells.clone() {
                add_codes(&mut sums.0, cell.chunks(BLOCK).nth(i).unwrap_or_default());
            }
            let velocity_multipliers = args.velocity_multipliers.chunks(BLOCK).nth(i).unwrap_or_default();
            for (channel, ((code, position), sum)) in row.iter_mut().zip(position).zip(sums.0).enumerate() {
                let pooled = i64::from(sum).wrapping_sub(offset).wrapping_mul(source.multiplier.into());
                let multiplier = velocity_multipliers.get(channel).copied().unwrap_or_default();
                let velocity = i64::from(args.velocity) * i64::from(multiplier);
                *code = ending.code_at(pooled.wrapping_add(velocity), (*position).into());
            }
        }
    }
    grid_h * grid_w
}

#[cfg(test)]
mod tests {
    use super::super::testing::{for_backends, multiplier, sum, zero_point};
    use super::BLOCK;
    use crate::kernels::{Kernels, Portable, TokenSourceArgs, TokensArgs};
    use crate::tensor::Shape;

    #[test]
    fn equals_portable() {
        for_backends(400, |kernels, rng| {
            let channels = [rng.range(1, 40), rng.range(1, 2 * BLOCK as i64 + 20)][rng.range(0, 1) as usize] as u16;
            let mut tokens = 0;
            let mut grid = || {
                let [h, w, pool_h, pool_w] = [(); 4].map(|()| rng.range(1, 4) as u16);
                tokens += usize::from(h * w);
                (Shape::map(h * pool_h, w * pool_w, channels), [pool_h as u8, pool_w as u8])
            };
            let grids = [grid(), grid()];
            let types = [rng.element_type(), rng.element_type()];
            let maps = [0, 1].map(|k| rng.buffer(types[k], grids[k].0.elements() as usize));
            let sources = [0, 1].map(|k| TokenSourceArgs {
                codes: maps[k].codes(),
                shape: grids[k].0,
                zero_point: zero_point(rng, types[k]),
                pool: grids[k].1,
                multiplier: multiplier(rng),
            });
            let to = rng.element_type();
            // One in eight with an array that is too short, as in no image.
            let missing = usize::from(rng.next().is_multiple_of(8));
            let velocity_multipliers = rng.values(usize::from(channels) - missing, i32::MIN.into(), i32::MAX.into());
            let position = rng.values(tokens * usize::from(channels) - missing, -32768, 32767);
            let args = TokensArgs {
                sources,
                velocity: rng.range(-32768, 32767) as i16,
                velocity_multipliers: &velocity_multipliers,
                position: &position,
                sum: sum(rng, to),
            };
            let mut expected = rng.buffer(to, tokens * usize::from(channels));
            let mut output = expected.clone();
            Portable.tokens(&args, expected.codes_mut());
            kernels.tokens(&args, output.codes_mut());
            assert_eq!(output, expected, "{grids:?}");
        });
    }

    #[test]
    fn hostile_shapes_give_what_portable_gives() {
        for_backends(300, |kernels, rng| {
            let map = rng.buffer(crate::tensor::ElementType::I16, 8);
            let source = TokenSourceArgs {
                codes: map.codes(),
                shape: Shape::map(2, 2, 2),
                zero_point: i16::MAX,
                pool: [1, 2],
                multiplier: i32::MIN,
            };
            let sources = [
                source,
                TokenSourceArgs { pool: [0, 255], ..source },
                TokenSourceArgs { shape: Shape::map(65535, 65535, 65535), ..source },
                TokenSourceArgs { shape: Shape::map(8, 1, 1), pool: [3, 1], ..source },
                TokenSourceArgs { shape: Shape::map(2, 0, 2), ..source },
            ];
            let mut pick = || sources[rng.range(0, 4) as usize];
            let sources = [pick(), pick()];
            let len = rng.range(0, 12) as usize;
            let position = rng.values(len, -32768, 32767);
            let to = rng.element_type();
            let sum = sum(rng, to);
            let args =
                TokensArgs { sources, velocity: i16::MIN, velocity_multipliers: &[i32::MIN], position: &position, sum };
            let len = rng.range(0, 12) as usize;
            let mut expected = rng.buffer(to, len);
            let mut output = expected.clone();
            Portable.tokens(&args, expected.codes_mut());
            kernels.tokens(&args, output.codes_mut());
            assert_eq!(output, expected, "{args:?}");
        });
    }
}
