//! Portable tokens.

use super::codes::{Code, block, block_mut, element, value};
use crate::fault::{self, Fault};
use crate::fixed_point::finish;
use crate::kernels::{TokenSourceArgs, TokensArgs};
use crate::tensor::{Codes, CodesMut};

/// `x_tc = clamp(z_o + R(Σ(q − z)·M + v·U_c, n) + P_tc)`.
///
/// Each source, an i8 or i16 map `H×W×C`, is pooled to `H/pool_h × W/pool_w` tokens in raster order; the tokens of the
/// first source come first. `output`: i16 (or i8), `T×C`; `position`: `[T][C]`. Precondition: `|Σ| < 2^52`.
pub fn tokens(args: &TokensArgs<'_>, output: CodesMut<'_>) {
    match output {
        CodesMut::I8(output) => run(args, output),
        CodesMut::I16(output) => run(args, output),
    }
}

fn run<T: Code>(args: &TokensArgs<'_>, output: &mut [T]) {
    let mut first_token = 0;
    for (number, source) in args.sources.iter().enumerate() {
        let by_columns = number == 1 && fault::active(Fault::TokenOrder);
        first_token += match source.codes {
            Codes::I8(codes) => pool(args, source, codes, first_token, by_columns, output),
            Codes::I16(codes) => pool(args, source, codes, first_token, by_columns, output),
        };
    }
}

/// Writes the tokens of one source from `first_token` on and returns their number.
fn pool<I: Code, O: Code>(
    args: &TokensArgs<'_>,
    source: &TokenSourceArgs<'_>,
    codes: &[I],
    first_token: usize,
    by_columns: bool,
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
    for (ty, tx) in (0..grid_h).flat_map(|ty| (0..grid_w).map(move |tx| (ty, tx))) {
        let token = first_token + if by_columns { tx * grid_h + ty } else { ty * grid_w + tx };
        let (Some(row), Some(position)) = (block_mut(output, token, channels), block(args.position, token, channels))
        else {
            return 0;
        };
        for (channel, (code, position)) in row.iter_mut().zip(position).enumerate() {
            let cells = (ty * pool_h..(ty + 1) * pool_h)
                .flat_map(|y| (tx * pool_w..(tx + 1) * pool_w).map(move |x| (y * width + x) * channels + channel));
            let pooled: i64 =
                cells.filter_map(|at| codes.get(at)).map(|q| value(*q) - i64::from(source.zero_point)).sum();
            let velocity = i64::from(args.velocity) * i64::from(element(args.velocity_multipliers, channel));
            let sum = pooled.wrapping_mul(i64::from(source.multiplier)).wrapping_add(velocity);
            let offset = i64::from(args.sum.zero_point) + i64::from(*position);
            *code = O::from_code(finish(sum, args.sum.shift, offset, args.sum.clamp));
        }
    }
    grid_h * grid_w
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::{Buffer, clamp, for_seeds, round};
    use super::*;
    use crate::kernels::SumArgs;
    use crate::program::Clamp;
    use crate::tensor::Shape;
    use std::vec::Vec;

    fn expected(args: &TokensArgs<'_>, maps: &[Buffer; 2]) -> Vec<i128> {
        let mut codes = Vec::new();
        for (source, map) in args.sources.iter().zip(maps) {
            let [pool_h, pool_w] = source.pool.map(usize::from);
            let (width, channels) = (usize::from(source.shape.width), usize::from(source.shape.channels));
            let (grid_h, grid_w) = (usize::from(source.shape.height) / pool_h, width / pool_w);
            for element in 0..grid_h * grid_w * channels {
                let (token, channel) = (element / channels, element % channels);
                let mut sum = i128::from(args.velocity) * i128::from(args.velocity_multipliers[channel]);
                for cell in 0..pool_h * pool_w {
                    let y = token / grid_w * pool_h + cell / pool_w;
                    let x = token % grid_w * pool_w + cell % pool_w;
                    let q = map.get((y * width + x) * channels + channel);
                    sum += (q - i128::from(source.zero_point)) * i128::from(source.multiplier);
                }
                let position = i128::from(args.position[codes.len()]);
                let value = i128::from(args.sum.zero_point) + round(sum, args.sum.shift) + position;
                codes.push(clamp(value, args.sum.clamp));
            }
        }
        codes
    }

    #[test]
    fn equals_the_formula() {
        for_seeds(300, |rng| {
            let channels = rng.range(1, 20) as u16;
            let mut tokens = 0;
            let mut grid = || {
                let [h, w, pool_h, pool_w] = [(); 4].map(|()| rng.range(1, 4) as u16);
                tokens += usize::from(h * w);
                (Shape::map(h * pool_h, w * pool_w, channels), [pool_h as u8, pool_w as u8])
            };
            let grids = [grid(), grid()];
            let types = [rng.element_type(), rng.element_type()];
            let maps = [0, 1].map(|k| rng.buffer(types[k], grids[k].0.elements() as usize));
            let source = |k: usize, zero_point, multiplier| TokenSourceArgs {
                codes: maps[k].codes(),
                shape: grids[k].0,
                zero_point,
                pool: grids[k].1,
                multiplier,
            };
            let to = rng.element_type();
            let count = tokens * usize::from(channels);
            let (velocity_multipliers, position) =
                (rng.values(usize::from(channels), -(1 << 24), 1 << 24), rng.values(count, -32768, 32767));
            let args = TokensArgs {
                sources: [0, 1].map(|k| source(k, rng.zero_point(types[k]), rng.range(1, 1 << 24) as i32)),
                velocity: rng.range(-32768, 32767) as i16,
                velocity_multipliers: &velocity_multipliers,
                position: &position,
                sum: SumArgs { shift: rng.range(16, 40) as u32, zero_point: rng.zero_point(to), clamp: rng.clamp(to) },
            };
            let mut output = rng.buffer(to, count);
            super::tokens(&args, output.codes_mut());
            output.assert_equals(&expected(&args, &maps), "tokens");
        });
    }

    #[test]
    fn hostile_constants_and_lengths_do_not_panic() {
        let source = TokenSourceArgs {
            codes: Codes::I16(&[i16::MIN; 8]),
            shape: Shape::map(2, 2, 2),
            zero_point: i16::MAX,
            pool: [1, 2],
            multiplier: i32::MIN,
        };
        let sum = SumArgs { shift: 255, zero_point: i16::MIN, clamp: Clamp { min: 1, max: -1 } };
        for second in [
            source,
            TokenSourceArgs { pool: [0, 255], ..source },
            TokenSourceArgs { shape: Shape::map(65535, 65535, 65535), ..source },
            TokenSourceArgs { shape: Shape::map(8, 1, 1), pool: [3, 1], ..source },
        ] {
            let args = TokensArgs {
                sources: [source, second],
                velocity: i16::MIN,
                velocity_multipliers: &[i32::MIN],
                position: &[i16::MIN; 8],
                sum,
            };
            tokens(&args, CodesMut::I16(&mut [0; 8]));
            tokens(&args, CodesMut::I8(&mut [0; 3]));
        }
    }
}
