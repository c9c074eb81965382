//! The softmax rows that the engine uses, from the codes of its own tensors.
//!
//! The engine keeps no row: it forms one at a time and drops it. So the rows are formed again from the codes of queries
//! and keys as the engine wrote them, by the formula of [`program::Attention`] and the runtime's own arithmetic, and
//! then proven on every frame: rows, the engine's values and the rest of the formula must give the context that the
//! engine wrote, code for code.

use super::AttentionMap;
use super::block::{FUSING_ONLY, IntegerBlock};
use crate::backends::Backend;
use crate::codes::decode;
use crate::run::Device;
use firmware::fixed_point::{EXP_TABLE_LEN, bits, divide, exp2_q15, finish, round_shift, saturate_i64};
use firmware::image::Image;
use firmware::program::{self, Clamp, Requant};
use firmware::tensor::{ElementType, TensorId};
use model_compiler::error::{Error, ErrorCode, Result};
use model_compiler::frames::Frame;
use std::collections::BTreeMap;

/// The formula of an attention step with its constants.
#[derive(Clone, Debug)]
pub struct Formula<'a> {
    /// C.
    pub channels: usize,
    /// Number of heads.
    pub heads: usize,
    /// `M_u`, `n_u`.
    pub exponent: Requant,
    /// `T`.
    pub exp_table: &'a [i16; EXP_TABLE_LEN],
    /// M, n.
    pub requant: Requant,
    /// `z_o`.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
}

impl<'a> Formula<'a> {
    /// Of a step of an image; `None` where the image does not hold what the step names.
    pub fn of(image: &Image<'a>, step: &program::Attention) -> Option<Self> {
        Some(Self {
            channels: image.tensor(step.output)?.shape.channels.into(),
            heads: step.heads.into(),
            exponent: step.exponent,
            exp_table: image.constants(step.exp_table)?.try_into().ok()?,
            requant: step.requant,
            zero_point: step.zero_point,
            clamp: step.clamp,
        })
    }

    /// `e_j` (Q15) of every key, by query and head: `a_j = Σ q·k_j`, `u_j = min(R((max(a) − a_j)·M_u, n_u), 31·2^16)`,
    /// `e_j = 2^(−u_j)`. The probability is `e_j / Σ e_j`.
    pub fn weights(&self, query: &[i32], key: &[i32]) -> AttentionMap {
        let size = self.channels / self.heads;
        let mut weights = Vec::new();
        for query in query.chunks_exact(self.channels) {
            for (head, query) in query.chunks_exact(size).enumerate() {
                let logit = |key: &[i32]| -> i64 {
                    let key = &key[head * size..][..size];
                    query.iter().zip(key).map(|(&q, &k)| i64::from(q) * i64::from(k)).sum()
                };
                let logits: Vec<i64> = key.chunks_exact(self.channels).map(logit).collect();
                let peak = logits.iter().copied().max().unwrap_or(0);
                weights.extend(logits.iter().map(|logit| {
                    let exponent = (peak - logit) * i64::from(self.exponent.multiplier);
                    f32::from(exp2_q15(self.exp_table, round_shift(exponent, self.exponent.shift.into())))
                }));
            }
        }
        AttentionMap { tokens: key.len() / self.channels, heads: self.heads, weights }
    }

    /// `ctx_t = clamp(z_o + R(R(A_t·R_s, c + 10)·M, n))` with `A_t = Σ_j e_j·v_jt`, `S = Σ e_j`, `c = bits(S)`,
    /// `R_s = floor(2^(c+22)/S)`, from rows of [`Self::weights`].
    pub fn context(&self, map: &AttentionMap, value: &[i32]) -> Vec<i32> {
        let size = self.channels / self.heads;
        let mut context = Vec::new();
        for query in 0..map.tokens {
            for channel in 0..self.channels {
                let row = map.row(channel / size, query);
                let values = value.iter().skip(channel).step_by(self.channels);
                let (mut sum, mut mixed) = (0_i64, 0_i64);
                for (&weight, &value) in row.iter().zip(values) {
                    sum += weight as i64;
                    mixed += weight as i64 * i64::from(value);
                }
                let digits = bits(sum);
                let reciprocal = saturate_i64(divide(1 << (digits + 22), sum.unsigned_abs()));
                let mean = round_shift(mixed * reciprocal, digits + 10);
                let product = mean * i64::from(self.requant.multiplier);
                context.push(finish(product, self.requant.shift.into(), self.zero_point.into(), self.clamp).into());
            }
        }
        context
    }
}

/// An image that shows one of its attention blocks.
pub struct IntegerAttention<'a> {
    image: Image<'a>,
    device: Device<'a>,
    block: IntegerBlock,
    formula: Formula<'a>,
}

impl<'a> IntegerAttention<'a> {
    /// Prepares an image.
    ///
    /// # Errors
    /// The image has no output, or does not hold what the step names.
    pub fn new(image: Image<'a>, block: IntegerBlock, backend: Backend) -> Result<Self> {
        let formula = Formula::of(&image, &block.step).ok_or_else(|| missing(&block))?;
        Ok(Self { image, device: Device::new(image, backend)?, block, formula })
    }

    /// The rows of a frame.
    ///
    /// # Errors
    /// The frame lacks an input, or the engine refuses; [`ErrorCode::Check`] where the rows do not give the context
    /// that the engine wrote.
    pub fn map(&mut self, frame: &Frame) -> Result<AttentionMap> {
        let block = &self.block;
        let step = &block.step;
        let mut operands: BTreeMap<TensorId, Vec<u8>> = BTreeMap::new();
        let mut context = Vec::new();
        // The context may lie where the queries were, so each is taken when it is written.
        self.device.infer_observed(frame, |position, ran, bytes| {
            if position == block.position {
                context = bytes.to_vec();
            } else if position < block.position && [step.query, step.key, step.value].contains(&ran.output()) {
                operands.insert(ran.output(), bytes.to_vec());
            }
        })?;
        let operand =
            |id: TensorId| operands.get(&id).map(|codes| decode(codes, ElementType::I8)).ok_or_else(|| missing(block));
        let map = self.formula.weights(&operand(step.query)?, &operand(step.key)?);
        let element = self.image.tensor(step.output).map_or(ElementType::I8, |tensor| tensor.element);
        let (found, expected) = (decode(&context, element), self.formula.context(&map, &operand(step.value)?));
        match found.iter().zip(&expected).position(|(found, expected)| found != expected) {
            None if found.len() == expected.len() => Ok(map),
            at => {
                let at = at.unwrap_or(found.len().min(expected.len()));
                let code = |codes: &[i32]| codes.get(at).map_or("none".to_owned(), i32::to_string);
                let (token, channel) = (at / self.formula.channels, at % self.formula.channels);
                let message = format!(
                    "the engine's context is not what queries, keys and values give: token {token}, channel {channel}: \
                     found {}, expected {}",
                    code(&found),
                    code(&expected)
                );
                let error = Error::new(ErrorCode::Check, format!("attention block {}", block.block.name), message);
                Err(error.with_help("host-sim verify shows the first wrong element"))
            }
        }
    }
}

fn missing(block: &IntegerBlock) -> Error {
    let message = "its queries, keys or values are not written by a step of the image";
    let error = Error::new(ErrorCode::Unsupported, format!("attention block {}", block.block.name), message);
    error.with_help(FUSING_ONLY)
}

#[cfg(test)]
mod tests {
    use super::*;
    use model_compiler::quantize::tables::exp2_table;

    /// A logit of 1 is half a power of two.
    fn formula<'a>(channels: usize, heads: usize, exp_table: &'a [i16; EXP_TABLE_LEN]) -> Formula<'a> {
        Formula {
            channels,
            heads,
            exponent: Requant { multiplier: 1 << 23, shift: 23 - 15 },
            exp_table,
            requant: Requant { multiplier: 1 << 23, shift: 23 + 12 },
            zero_point: 0,
            clamp: Clamp { min: -128, max: 127 },
        }
    }

    #[test]
    fn a_weight_halves_where_the_logit_falls_by_two() {
        let table: [i16; EXP_TABLE_LEN] = exp2_table().try_into().unwrap();
        let map = formula(1, 1, &table).weights(&[2, 0, -1], &[3, 2, -4]);
        // Logits 6, 4, −8; 0, 0, 0; −3, −2, 4.
        assert_eq!(map.row(0, 0), [32767.0, 16384.0, 256.0]);
        assert_eq!(map.row(0, 1), [32767.0; 3]);
        let half = f32::from(table[128]);
        assert_eq!(map.row(0, 2), [(half / 8.0).round(), 4096.0, 32767.0]);
    }

    #[test]
    fn heads_have_channels_of_their_own() {
        let table: [i16; EXP_TABLE_LEN] = exp2_table().try_into().unwrap();
        let both = formula(4, 2, &table).weights(&[1, 2, -3, 0, 0, 1, 2, 2], &[1, 1, 0, 4, 2, -1, 1, 1]);
        let first = formula(2, 1, &table).weights(&[1, 2, 0, 1], &[1, 1, 2, -1]);
        let second = formula(2, 1, &table).weights(&[-3, 0, 2, 2], &[0, 4, 1, 1]);
        for query in 0..2 {
            assert_eq!(both.row(0, query), first.row(0, query));
            assert_eq!(both.row(1, query), second.row(0, query));
        }
    }

    #[test]
    fn equal_logits_average_the_values_and_a_far_one_stands_alone() {
        let table: [i16; EXP_TABLE_LEN] = exp2_table().try_into().unwrap();
        let formula = formula(1, 1, &table);
        let context = |query: [i32; 3], key: [i32; 3]| formula.context(&formula.weights(&query, &key), &[-90, 30, 61]);
        assert_eq!(context([0; 3], [1, 2, 3]), [0; 3], "(−90 + 30 + 61) / 3 = 1/3");
        assert_eq!(context([127, -127, 127], [-127, 1, 127]), [61, -90, 61]);
    }
}
