//! Pooled maps, positions and velocity to the tokens of a residual stream.

use super::arithmetic::{Exactness, Requantizer, to_f64};
use super::operands::{Operands, expect};
use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::{QTensorId, QTokenSource};

/// What is added to the pooled maps.
pub(super) struct Embedding<'a> {
    pub(super) velocity: QTensorId,
    /// `U_c` per channel.
    pub(super) velocity_multipliers: &'a [i32],
    /// `P_tc`, `[T][C]`.
    pub(super) position: &'a [i16],
}

/// `x_tc = clamp(z_o + R(Σ(q − z)·M + v·U_c, n) + P_tc)`; tokens of the first source come first, row-major.
pub(super) fn tokens(
    operands: &Operands,
    sources: &[QTokenSource],
    output: QTensorId,
    embedding: &Embedding,
    requantizer: &Requantizer,
) -> Result<Vec<f64>> {
    let channels = usize::from(operands.shape(output)?.channels);
    expect("velocity multipliers", embedding.velocity_multipliers.len(), channels)?;
    let velocity = operands.codes(embedding.velocity)?;
    expect("values of the velocity", velocity.len(), 1)?;

    let mut exact = Exactness::default();
    let mut sums = Vec::new();
    for source in sources {
        let multiplier = f64::from(source.multiplier);
        let pooled = pooled_sums(operands, source, channels)?;
        sums.extend(pooled.into_iter().map(|sum| exact.watch(sum * multiplier)));
    }
    expect("elements of the tokens", sums.len(), operands.shape(output)?.elements() as usize)?;
    expect("positional embedding", embedding.position.len(), sums.len())?;
    let speed: Vec<f64> = to_f64(embedding.velocity_multipliers).iter().map(|u| exact.watch(velocity[0] * u)).collect();
    let code = |(element, sum): (usize, f64)| {
        let total = sum + speed[element % channels];
        requantizer.code_plus(total, f64::from(embedding.position[element]), &mut exact)
    };
    let codes = sums.into_iter().enumerate().map(code).collect();
    exact.finish()?;
    Ok(codes)
}

/// `Σ(q − z)` per cell of the token grid and channel.
fn pooled_sums(operands: &Operands, source: &QTokenSource, channels: usize) -> Result<Vec<f64>> {
    let shape = operands.shape(source.map)?;
    let (height, width) = (usize::from(shape.height), usize::from(shape.width));
    let (pool_h, pool_w) = (usize::from(source.pool_h), usize::from(source.pool_w));
    expect("channels of the map", usize::from(shape.channels), channels)?;
    if pool_h == 0 || pool_w == 0 || !height.is_multiple_of(pool_h) || !width.is_multiple_of(pool_w) {
        let message = format!("a pool of {pool_h}×{pool_w} does not divide a map of {height}×{width}");
        return Err(Error::new(ErrorCode::Malformed, "", message));
    }
    let grid_width = width / pool_w;
    let mut sums = vec![0.0; height / pool_h * grid_width * channels];
    for (pixel, codes) in operands.codes(source.map)?.chunks_exact(channels).enumerate() {
        let cell = pixel / width / pool_h * grid_width + pixel % width / pool_w;
        for (sum, code) in sums[cell * channels..].iter_mut().zip(codes) {
            *sum += code - f64::from(source.zero_point);
        }
    }
    Ok(sums)
}

#[cfg(test)]
mod tests {
    use crate::error::ErrorCode;
    use crate::integer_reference::testing::{Random, clamp, execute_alone, rounding_shift};
    use crate::qmodel::{QOp, QTensorId, QTokenSource};
    use firmware::tensor::{ElementType, Shape};

    fn source(map: u32, zero_point: i16, pool: (u8, u8), multiplier: i32) -> QTokenSource {
        QTokenSource { map: QTensorId(map), zero_point, pool_h: pool.0, pool_w: pool.1, multiplier }
    }

    fn op(sources: [QTokenSource; 2], velocity_multipliers: Vec<i32>, position: Vec<i16>, shift: u8) -> QOp {
        QOp::Tokens {
            first: sources[0],
            second: sources[1],
            velocity: QTensorId(2),
            output: QTensorId(3),
            velocity_multipliers,
            position,
            shift,
            zero_point: 0,
            clamp: clamp(-32768, 32767),
        }
    }

    #[test]
    fn first_map_comes_first_and_positions_are_added_after_rounding() {
        let sources = [source(0, 0, (1, 2), 1), source(1, 1, (1, 1), 2)];
        let operands = [
            (Shape::map(1, 4, 1), ElementType::I8, vec![1.0, 2.0, -3.0, -4.0]),
            (Shape::map(1, 2, 1), ElementType::I8, vec![1.0, 11.0]),
            (Shape::vector(1), ElementType::I16, vec![4.0]),
        ];
        // Sums 3, −7, 0, 20 plus velocity 4·(−1), halved with ties up; then the positions.
        let op = op(sources, vec![-1], vec![100, 200, 300, 400], 1);
        let codes = execute_alone(op, &operands, (Shape::tokens(4, 1), ElementType::I16)).unwrap();
        assert_eq!(codes, [100.0, 195.0, 298.0, 408.0]);
    }

    #[test]
    fn tokens_equal_wide_integers() {
        let seed = 0x70;
        let mut random = Random(seed);
        let (channels, grid) = (5, (4, 3));
        let pools = [(2u8, 4u8), (3, 1)];
        let shapes = pools.map(|(h, w)| Shape::map(grid.0 * u16::from(h), grid.1 * u16::from(w), channels));
        let codes = shapes.map(|s| random.codes(s.elements() as usize, -128, 127));
        let velocity = random.between(-32768, 32767);
        let speeds: Vec<i32> = random.vec(5, i64::from(i32::MIN + 1), i64::from(i32::MAX));
        let positions: Vec<i16> = random.vec(24 * 5, -32768, 32767);
        let sources = [source(0, -128, pools[0], 1_111_111_111), source(1, 9, pools[1], 2_147_483_647)];
        let operands = [
            (shapes[0], ElementType::I8, codes[0].clone()),
            (shapes[1], ElementType::I8, codes[1].clone()),
            (Shape::vector(1), ElementType::I16, vec![velocity as f64]),
        ];
        let op = op(sources, speeds.clone(), positions.clone(), 32);
        let result = execute_alone(op, &operands, (Shape::tokens(24, channels), ElementType::I16)).unwrap();
        let (grid, channels) = ((usize::from(grid.0), usize::from(grid.1)), usize::from(channels));
        for (element, &code) in result.iter().enumerate() {
            let (token, channel) = (element / channels, element % channels);
            let (map, cell) = (token / (grid.0 * grid.1), token % (grid.0 * grid.1));
            let (pool_h, pool_w) = (usize::from(pools[map].0), usize::from(pools[map].1));
            let mut sum = 0i128;
            for y in 0..pool_h {
                for x in 0..pool_w {
                    let pixel = (cell / grid.1 * pool_h + y) * grid.1 * pool_w + cell % grid.1 * pool_w + x;
                    sum += codes[map][pixel * channels + channel] as i128 - i128::from(sources[map].zero_point);
                }
            }
            let total = sum * i128::from(sources[map].multiplier) + i128::from(velocity) * i128::from(speeds[channel]);
            let expected = (rounding_shift(total, 32) + i128::from(positions[element])).clamp(-32768, 32767);
            assert_eq!(code as i128, expected, "element {element}, seed {seed:#x}");
        }
    }

    #[test]
    fn a_pool_must_divide_its_map() {
        let sources = [source(0, 0, (1, 3), 1), source(1, 1, (1, 1), 2)];
        let operands = [
            (Shape::map(1, 4, 1), ElementType::I8, vec![0.0; 4]),
            (Shape::map(1, 2, 1), ElementType::I8, vec![0.0; 2]),
            (Shape::vector(1), ElementType::I16, vec![4.0]),
        ];
        let op = op(sources, vec![-1], vec![0; 4], 1);
        let error = execute_alone(op, &operands, (Shape::tokens(4, 1), ElementType::I16)).unwrap_err();
        assert_eq!(error.code, ErrorCode::Malformed);
    }
}
