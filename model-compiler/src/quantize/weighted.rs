//! Convolutions and linear layers: i8 weights per output channel, effective bias, epilogue.

use super::factors::{self, Factor, bits, round};
use super::rounding::Rounding;
use super::{Builder, bounds_of};
use crate::calibrate;
use crate::error::{Error, ErrorCode, Result};
use crate::ir::{Clip, Conv2d, Linear, Node, Normalization, ValueId, Weights};
use crate::qmodel::{Bounds, QOp, QRescale, QResidual, QTensorId};
use firmware::tensor::ElementType;
use std::sync::Arc;

/// Bits that an accumulator may have before it is multiplied, in the plain form and as a term of a sum.
const REQUANT_ACCUMULATOR_BITS: u32 = 28;
const TERM_ACCUMULATOR_BITS: u32 = 31;

/// The weights of one layer as the quantizer sees them: `outputs` rows of `taps × inputs`.
pub(super) struct Layer<'a> {
    pub weights: &'a [f32],
    pub bias: Option<&'a [f32]>,
    /// Of all branches.
    pub outputs: usize,
    pub inputs: usize,
    pub groups: usize,
    /// Blocks of outputs of which a command selects one; 1 where there is nothing to select.
    pub branches: usize,
    pub normalization: Option<&'a Normalization>,
    pub clip: Clip,
}

impl Layer<'_> {
    fn depth(&self) -> usize {
        self.weights.len() / self.outputs
    }

    /// Input channel that element `k` of row `output` multiplies.
    fn channel(&self, output: usize, k: usize) -> usize {
        let group = output / (self.outputs / self.groups);
        group * self.inputs + k % self.inputs
    }
}

/// Integer weights of a layer with what the epilogue needs to know.
struct IntegerLayer {
    weights: Vec<i8>,
    weight_scales: Vec<f64>,
    bias: Vec<i32>,
    /// Largest magnitude of the true accumulator, per output.
    value_bounds: Vec<f64>,
    /// Largest magnitude of any partial sum of raw codes over all outputs.
    partial_bound: f64,
}

impl Builder<'_> {
    pub(super) fn conv2d(&mut self, node: &Node, conv: &Conv2d) -> Result<()> {
        if super::is_linear(conv, self.graph.value(node.inputs[0]).shape) {
            let weights =
                Weights { shape: vec![conv.weights.shape[0], conv.weights.shape[3]], ..(*conv.weights).clone() };
            let linear = Linear { weights: Arc::new(weights), bias: conv.bias.clone(), clip: conv.clip };
            return self.linear(node, &linear);
        }
        let input = self.narrow(node.inputs[0])?;
        let layer = Layer {
            weights: &conv.weights.data,
            bias: conv.bias.as_deref().map(Vec::as_slice),
            outputs: conv.weights.shape[0],
            inputs: conv.weights.shape[3],
            groups: usize::from(conv.groups),
            branches: 1,
            normalization: conv.normalization.as_deref(),
            clip: conv.clip,
        };
        let residual = node.inputs.get(1).copied();
        let (weights, rescale, bounds, _) = self.weighted(node, &layer, input, residual)?;
        let output = self.tensor(node.output);
        let padding_codes = match &conv.normalization {
            Some(n) => n.mean.iter().map(|&mean| self.code(input, mean).clamp(-128.0, 127.0) as i8).collect(),
            None => vec![self.zero_point(input) as i8; layer.inputs * layer.groups],
        };
        let (window, groups) = (conv.window, conv.groups);
        self.step(node, QOp::Conv2d { input, output, window, groups, weights, padding_codes, rescale }, bounds);
        Ok(())
    }

    pub(super) fn linear(&mut self, node: &Node, linear: &Linear) -> Result<()> {
        let input = self.tensor(node.inputs[0]);
        let layer = Layer {
            weights: &linear.weights.data,
            bias: linear.bias.as_deref().map(Vec::as_slice),
            outputs: linear.weights.shape[0],
            inputs: linear.weights.shape[1],
            groups: 1,
            branches: 1,
            normalization: None,
            clip: linear.clip,
        };
        let residual = node.inputs.get(1).copied();
        let (weights, rescale, bounds, wide) = self.weighted(node, &layer, input, residual)?;
        let output = self.tensor(node.output);
        self.step(node, QOp::Linear { input, output, weights, wide, rescale }, bounds);
        Ok(())
    }

    /// Weights, epilogue and bounds of a layer, and whether its accumulators need 64 bits.
    pub(super) fn weighted(
        &mut self,
        node: &Node,
        layer: &Layer<'_>,
        input: QTensorId,
        residual: Option<ValueId>,
    ) -> Result<(Vec<i8>, QRescale, Bounds, bool)> {
        let output = self.tensor(node.output);
        let residual = residual.map(|value| self.tensor(value));
        let integer = self.integer_layer(node, layer, input, output)?;
        let (rescale, mut bounds) = self.rescale(layer, &integer, input, output, residual)?;
        let half = f64::exp2(f64::from(rescale.pre_shift)) / 2.0;
        let accumulator_bits = bits(integer.partial_bound + half);
        let wide = accumulator_bits > 31;
        if wide && self.model.tensor(input).element == ElementType::I8 {
            return Err(Error::new(
                ErrorCode::Numeric,
                "",
                format!("the accumulator may need {accumulator_bits} bits, expected at most 31"),
            )
            .with_help("split the layer into groups of input channels"));
        }
        bounds.accumulator_bits = accumulator_bits as u8;
        bounds.clipped = self.clipped(output, layer.clip);
        let spare = if wide { 63 - accumulator_bits } else { 31 - accumulator_bits };
        bounds.headroom_bits = bounds.headroom_bits.min(spare as u8);
        Ok((integer.weights, rescale, bounds, wide))
    }

    fn integer_layer(
        &self,
        node: &Node,
        layer: &Layer<'_>,
        input: QTensorId,
        output: QTensorId,
    ) -> Result<IntegerLayer> {
        let source = node.inputs[0];
        let (input_scale, output_scale) = (self.scale(input), self.scale(output));
        let zero_point = f64::from(self.zero_point(input));
        let magnitude = self.magnitude(input);
        let raw_magnitude = if self.model.tensor(input).element == ElementType::I8 { 383.0 } else { 32768.0 };
        let channels = layer.inputs * layer.groups;
        let of_branches = |means: &[f64]| -> Vec<Vec<f64>> {
            let branch = |branch| calibrate::branch_means(means, channels, (layer.branches > 1).then_some(branch));
            (0..layer.branches).map(branch).collect()
        };
        let means = of_branches(&self.statistics.of(source).channel_mean);
        let quantized_means = of_branches(&self.quantized_means[source.0 as usize]);
        let roundings: Vec<Rounding> = match self.covariances.of(node.output) {
            Some(covariances) => covariances.iter().map(Rounding::by).collect(),
            None => vec![Rounding::nearest(); layer.groups],
        };
        let mut integer = IntegerLayer {
            weights: Vec::with_capacity(layer.weights.len()),
            weight_scales: Vec::with_capacity(layer.outputs),
            bias: Vec::with_capacity(layer.outputs),
            value_bounds: Vec::with_capacity(layer.outputs),
            partial_bound: 0.0,
        };
        for (o, row) in layer.weights.chunks_exact(layer.depth()).enumerate() {
            let row = normalized_row(layer, o, row);
            let largest = row.iter().fold(0.0, |m: f64, w| m.max(w.abs()));
            let mut bias = layer.bias.map_or(0.0, |b| f64::from(b[o]));
            let scale = (largest / 127.0)
                .max(bias.abs() / (input_scale * f64::exp2(27.0)))
                .max(f64::exp2(-26.0) * output_scale / input_scale);
            let codes = roundings[o / (layer.outputs / layer.groups)].round(&row, scale);
            let branch = o / (layer.outputs / layer.branches);
            let mean_of = |k: usize| layer.normalization.map_or(0.0, |n| f64::from(n.mean[layer.channel(o, k)]));
            if self.options.bias_correction {
                // What the layer gives on average with quantized weights and inputs, less what it should give.
                let mean_error = |(k, (q, w)): (usize, (&f64, &f64))| {
                    let (channel, center) = (layer.channel(o, k), mean_of(k));
                    q * scale * (quantized_means[branch][channel] - center) - w * (means[branch][channel] - center)
                };
                bias -= codes.iter().zip(&row).enumerate().map(mean_error).sum::<f64>();
            }
            let code_sum: f64 = codes.iter().sum();
            let code_magnitude: f64 = codes.iter().map(|q| q.abs()).sum();
            let mean_sum: f64 = codes.iter().enumerate().map(|(k, q)| q * mean_of(k)).sum();
            let effective = round(bias / (input_scale * scale) - mean_sum / input_scale) - zero_point * code_sum;
            if effective.abs() >= f64::exp2(31.0) {
                return Err(Error::new(ErrorCode::Numeric, format!("output channel {o}"), "the bias exceeds 32 bits"));
            }
            integer.value_bounds.push((effective + zero_point * code_sum).abs() + code_magnitude * magnitude);
            integer.partial_bound = integer.partial_bound.max(effective.abs() + raw_magnitude * code_magnitude);
            integer.weights.extend(codes.iter().map(|&q| q as i8));
            integer.weight_scales.push(scale);
            integer.bias.push(effective as i32);
        }
        Ok(integer)
    }

    fn rescale(
        &self,
        layer: &Layer<'_>,
        integer: &IntegerLayer,
        input: QTensorId,
        output: QTensorId,
        residual: Option<QTensorId>,
    ) -> Result<(QRescale, Bounds)> {
        let largest = integer.value_bounds.iter().copied().fold(0.0, f64::max);
        let (input_scale, output_scale) = (self.scale(input), self.scale(output));
        let mut rescale = QRescale {
            pre_shift: 0,
            bias: integer.bias.clone(),
            multipliers: Vec::with_capacity(layer.outputs),
            shifts: Vec::with_capacity(layer.outputs),
            zero_point: self.zero_point(output),
            clamp: self.clamp(output, layer.clip),
            residual: QResidual::None,
        };
        let in_stream = residual.is_some_and(|r| {
            let (r, y) = (self.model.tensor(r), self.model.tensor(output));
            r.element == ElementType::I16 && y.element == ElementType::I16 && r.scale == y.scale
        });
        let mut worst = 0.0;
        let mut rounding: f64 = 0.0;
        match residual {
            Some(tensor) if !in_stream => {
                rescale.pre_shift = bits(largest).saturating_sub(TERM_ACCUMULATOR_BITS) as u8;
                let mut multipliers = Vec::with_capacity(layer.outputs);
                for (scale, bound) in integer.weight_scales.iter().zip(&integer.value_bounds) {
                    let unit = f64::exp2(f64::from(rescale.pre_shift));
                    let terms = factors::terms(
                        &[
                            Factor { m: input_scale * scale / output_scale * unit, bound: bound / unit + 1.0 },
                            Factor { m: self.scale(tensor) / output_scale, bound: self.magnitude(tensor) },
                        ],
                        0.0,
                        40,
                    )?;
                    rescale.multipliers.push(terms.multipliers[0]);
                    multipliers.push(terms.multipliers[1]);
                    rescale.shifts.push(terms.shift);
                    worst = f64::max(worst, terms.bound);
                    rounding = rounding.max(terms.rounding);
                }
                rescale.residual = QResidual::Scaled { tensor, zero_point: self.zero_point(tensor), multipliers };
            }
            _ => {
                rescale.pre_shift = bits(largest).saturating_sub(REQUANT_ACCUMULATOR_BITS) as u8;
                let unit = f64::exp2(f64::from(rescale.pre_shift));
                for (scale, bound) in integer.weight_scales.iter().zip(&integer.value_bounds) {
                    let requant = factors::requant(input_scale * scale / output_scale * unit)?;
                    rescale.multipliers.push(requant.multiplier);
                    rescale.shifts.push(requant.shift);
                    worst = f64::max(worst, (bound / unit + 1.0) * f64::from(requant.multiplier));
                }
                if let Some(tensor) = residual {
                    rescale.residual = QResidual::Stream { tensor };
                }
            }
        }
        Ok((rescale, bounds_of(0, &[worst], rounding)))
    }
}

/// One row of weights in f64, with the normalization of a raw input divided in.
fn normalized_row(layer: &Layer<'_>, output: usize, row: &[f32]) -> Vec<f64> {
    row.iter()
        .enumerate()
        .map(|(k, &w)| {
            let std = layer.normalization.map_or(1.0, |n| f64::from(n.std[layer.channel(output, k)]));
            f64::from(w) / std
        })
        .collect()
}
