//! Operators of the transformers: tokens, LayerNorm, attention.

use super::factors::{self, Factor, bits, round};
use super::{Builder, bounds_of, tables};
use crate::error::{Error, ErrorCode, Result};
use crate::ir::{Clip, LayerNorm, Node, Tokens};
use crate::qmodel::{QOp, QTensorId, QTokenSource};
use firmware::tensor::ElementType;

/// Largest row, head and channel counts for which the bounds of the numerics page hold.
const MAX_TOKENS: u32 = 512;
const MAX_HEAD_WIDTH: u16 = 512;
const MAX_NORM_CHANNELS: u16 = 1024;

fn too_large(what: &str, found: impl std::fmt::Display, limit: impl std::fmt::Display) -> Error {
    Error::new(ErrorCode::Numeric, "", format!("{what}: found {found}, expected at most {limit}"))
}

impl Builder<'_> {
    fn token_source(&self, map: QTensorId, grid: (u16, u16)) -> Result<QTokenSource> {
        let shape = self.model.tensor(map).shape;
        let pool = |size: u16, cells: u16| {
            u8::try_from(size / cells).map_err(|_| too_large("pooling window of the tokens", size / cells, 255))
        };
        Ok(QTokenSource {
            map,
            zero_point: self.zero_point(map),
            pool_h: pool(shape.height, grid.0)?,
            pool_w: pool(shape.width, grid.1)?,
            multiplier: 0,
        })
    }

    pub(super) fn tokens(&mut self, node: &Node, tokens: &Tokens) -> Result<()> {
        let output = self.tensor(node.output);
        let scale = self.scale(output);
        let velocity = self.tensor(node.inputs[2]);
        let maps = [self.tensor(node.inputs[0]), self.tensor(node.inputs[1])];
        let mut sources = [self.token_source(maps[0], tokens.grid)?, self.token_source(maps[1], tokens.grid)?];
        let steepest = tokens.velocity_weights.iter().map(|w| f64::from(w.abs())).fold(0.0, f64::max);
        let mut factors: Vec<Factor> = sources
            .iter()
            .map(|s| {
                let count = f64::from(s.pool_h) * f64::from(s.pool_w);
                Factor { m: self.scale(s.map) / (scale * count), bound: self.magnitude(s.map) * count }
            })
            .collect();
        let accumulator = factors[0].bound.max(factors[1].bound);
        factors.push(Factor { m: steepest / scale * self.scale(velocity), bound: 32768.0 });
        let terms = factors::terms(&factors, 0.0, 40)?;
        for (source, &multiplier) in sources.iter_mut().zip(&terms.multipliers) {
            source.multiplier = multiplier;
        }
        let unit = f64::exp2(f64::from(terms.shift)) * self.scale(velocity) / scale;
        let channels = tokens.velocity_bias.len();
        let count = usize::from(self.model.tensor(output).shape.height);
        let mut position = Vec::with_capacity(count * channels);
        for t in 0..count {
            for (c, &bias) in tokens.velocity_bias.iter().enumerate() {
                let embedded = tokens.position.as_ref().map_or(0.0, |p| f64::from(p.data[t * channels + c]));
                let code = round((embedded + f64::from(bias)) / scale);
                if code.abs() > 32767.0 {
                    return Err(too_large("code of the positional embedding", code, 32767));
                }
                position.push(code as i16);
            }
        }
        let op = QOp::Tokens {
            first: sources[0],
            second: sources[1],
            velocity,
            output,
            velocity_multipliers: tokens.velocity_weights.iter().map(|&w| round(f64::from(w) * unit) as i32).collect(),
            position,
            shift: terms.shift,
            zero_point: self.zero_point(output),
            clamp: self.clamp(output, Clip::NONE),
        };
        self.step(node, op, bounds_of(bits(accumulator), &[terms.bound], terms.rounding));
        Ok(())
    }

    pub(super) fn layer_norm(&mut self, node: &Node, norm: &LayerNorm) -> Result<()> {
        let (input, output) = (self.tensor(node.inputs[0]), self.tensor(node.output));
        let channels = self.model.tensor(input).shape.channels;
        if channels > MAX_NORM_CHANNELS {
            return Err(too_large("LayerNorm channels", channels, MAX_NORM_CHANNELS));
        }
        let (c, in_scale, out_scale) = (f64::from(channels), self.scale(input), self.scale(output));
        let epsilon = round(f64::from(norm.epsilon) * c * c / (in_scale * in_scale)).max(1.0);
        let variance_bound = c * c * self.code_magnitude(input).powi(2) + epsilon;
        if variance_bound >= f64::exp2(52.0) {
            return Err(too_large("bits of the LayerNorm variance", bits(variance_bound), 52));
        }
        let gains: Vec<f64> = norm.weight.iter().map(|&g| f64::from(g) / out_scale).collect();
        let offsets: Vec<f64> = norm.bias.iter().map(|&b| f64::from(b) / out_scale).collect();
        let largest = |v: &[f64]| v.iter().fold(0.0, |m: f64, x| m.max(x.abs()));
        let (gain, offset) = (largest(&gains), largest(&offsets));
        let fits = |n: &i32| {
            round(gain * f64::exp2(f64::from(n - 14))) < f64::exp2(24.0)
                && round(offset * f64::exp2(f64::from(*n))) < f64::exp2(51.0)
        };
        let shift = (0..=40).rev().find(fits).ok_or_else(|| too_large("LayerNorm gain", gain, "2^37"))?;
        let gain_unit = f64::exp2(f64::from(shift - 14));
        let offset_unit = f64::exp2(f64::from(shift));
        // A normalized value is at most √(C − 1) in magnitude, in Q14.
        let product = f64::exp2(14.0) * c.sqrt() * round(gain * gain_unit) + round(offset * offset_unit);
        let op = QOp::LayerNorm {
            input,
            output,
            first_row: norm.first_row,
            epsilon: epsilon as i64,
            gains: gains.iter().map(|g| round(g * gain_unit) as i32).collect(),
            offsets: offsets.iter().map(|b| round(b * offset_unit) as i64).collect(),
            shift: shift as u8,
            zero_point: self.zero_point(output),
            clamp: self.clamp(output, Clip::NONE),
        };
        self.step(node, op, bounds_of(bits(c * self.code_magnitude(input)), &[product, variance_bound], 0.0));
        Ok(())
    }

    pub(super) fn attention(&mut self, node: &Node, heads: u16) -> Result<()> {
        let [query, key, value] = [0, 1, 2].map(|k| self.tensor(node.inputs[k]));
        let output = self.tensor(node.output);
        let shape = self.model.tensor(query).shape;
        let width = shape.channels / heads;
        for operand in [query, key, value].map(|id| self.model.tensor(id)) {
            if operand.element != ElementType::I8 || operand.zero_point != 0 {
                let message = "found affine or 16-bit codes, expected symmetric 8-bit ones";
                return Err(Error::new(ErrorCode::Unsupported, format!("operand {}", operand.name), message)
                    .with_help("give attention the outputs of linear layers of their own"));
            }
        }
        if shape.positions() > MAX_TOKENS {
            return Err(too_large("attention tokens", shape.positions(), MAX_TOKENS));
        }
        if width > MAX_HEAD_WIDTH {
            return Err(too_large("attention head width", width, MAX_HEAD_WIDTH));
        }
        let root = f64::from(width).sqrt();
        let exponent =
            factors::requant(self.scale(query) * self.scale(key) * std::f64::consts::LOG2_E / root * f64::exp2(16.0))?;
        let requant = factors::requant(self.scale(value) / self.scale(output) * f64::exp2(-12.0))?;
        let scores = 2.0 * 127.0 * 127.0 * f64::from(width);
        let weighted = 127.0 * f64::from(shape.positions()) * 32767.0;
        let op = QOp::Attention {
            query,
            key,
            value,
            output,
            heads,
            exponent,
            exp_table: tables::exp2_table(),
            requant,
            zero_point: self.zero_point(output),
            clamp: self.clamp(output, Clip::NONE),
        };
        // |A·R_s| ≤ 127·2^(c+22), c ≤ 24: one bit below 2^53 for 512 keys.
        let normalized = 127.0 * f64::exp2(f64::from(bits(f64::from(shape.positions()) * 32767.0)) + 22.0);
        let products = [
            scores * f64::from(exponent.multiplier),
            normalized,
            127.0 * f64::exp2(12.0) * f64::from(requant.multiplier),
        ];
        self.step(node, op, bounds_of(bits(scores.max(weighted)), &products, 0.0));
        Ok(())
    }

    /// Largest magnitude of a raw code.
    fn code_magnitude(&self, id: QTensorId) -> f64 {
        f64::from(super::code_range(self.model.tensor(id).element).0).abs()
    }
}
