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
    let speed: Vec<f64> =
        to_f64(embedding.velocity_multipliers).iter().map(|u| exact.watch(velocity[0] * u)).collect();
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
