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
