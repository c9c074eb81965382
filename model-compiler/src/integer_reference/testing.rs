//! What the tests share: small models, seeded numbers, and the rounding rule once more in wide integers.

use super::execute;
use crate::error::Result;
use crate::ir::InputKind;
use crate::qmodel::{Bounds, Port, QModel, QOp, QRescale, QResidual, QStep, QTensor, QTensorId};
use firmware::program::{Clamp, Requant};
use firmware::tensor::{ElementType, Shape};

/// A model of tensors alone: scale 1, zero point 0.
pub fn model(tensors: &[(&str, Shape, ElementType)]) -> QModel {
    let tensor = |&(name, shape, element): &(&str, Shape, ElementType)| QTensor {
        name: name.into(),
        value: name.into(),
        shape,
        element,
        scale: 1.0,
        zero_point: 0,
        saturation_ppm: None,
    };
    QModel {
        name: "test".into(),
        system: "test".into(),
        tensors: tensors.iter().map(tensor).collect(),
        steps: Vec::new(),
        inputs: Vec::new(),
        outputs: Vec::new(),
        provenance: Vec::new(),
    }
}

pub fn step(name: &str, op: QOp) -> QStep {
    QStep { name: name.into(), node: None, op, bounds: Bounds::default() }
}

pub fn port(name: &str, tensor: u32, kind: Option<InputKind>) -> Port {
    Port { name: name.into(), tensor: QTensorId(tensor), kind }
}

pub fn clamp(min: i16, max: i16) -> Clamp {
    Clamp { min, max }
}

/// One operator over tensors 0, 1, … with these shapes, types and codes; the output is the last, without codes.
pub fn execute_alone(
    op: QOp,
    operands: &[(Shape, ElementType, Vec<f64>)],
    output: (Shape, ElementType),
) -> Result<Vec<f64>> {
    let mut tensors: Vec<_> = operands.iter().map(|(shape, element, _)| ("operand", *shape, *element)).collect();
    tensors.push(("output", output.0, output.1));
    let model = model(&tensors);
    execute(&model, &step("alone", op), |id| operands[id.0 as usize].2.as_slice())
}

/// `R(v, n)` in wide integers.
pub fn rounding_shift(value: i128, shift: u32) -> i128 {
    if shift == 0 { value } else { (value + (1 << (shift - 1))) >> shift }
}

/// Output code of one accumulator in wide integers; `residual` is the stored code of the second operand.
pub fn rescale_code(rescale: &QRescale, channel: usize, sum: i128, residual: i128) -> i128 {
    let t = rounding_shift(sum + i128::from(rescale.bias[channel]), u32::from(rescale.pre_shift));
    let product = t * i128::from(rescale.multipliers[channel]);
    let n = u32::from(rescale.shifts[channel]);
    let code = match &rescale.residual {
        QResidual::None => i128::from(rescale.zero_point) + rounding_shift(product, n),
        QResidual::Scaled { zero_point, multipliers, .. } => {
            let second = (residual - i128::from(*zero_point)) * i128::from(multipliers[channel]);
            i128::from(rescale.zero_point) + rounding_shift(product + second, n)
        }
        QResidual::Stream { .. } => residual + rounding_shift(product, n),
    };
    code.max(i128::from(rescale.clamp.min)).min(i128::from(rescale.clamp.max))
}

/// The multiplier and shift of a real factor (numerics, "Requantize").
pub fn requant(factor: f64) -> Requant {
    let n = 23 - factor.log2().floor() as i32;
    let multiplier = (factor * f64::from(n).exp2() + 0.5).floor() as i32;
    if multiplier == 1 << 24 {
        return Requant { multiplier: 1 << 23, shift: (n - 1) as u8 };
    }
    Requant { multiplier, shift: n as u8 }
}

/// `round(x) = floor(x + ½)`.
pub fn round(x: f64) -> f64 {
    (x + 0.5).floor()
}

/// Seeded numbers.
pub struct Random(pub u64);

impl Random {
    pub fn below(&mut self, limit: u64) -> u64 {
        self.0 = self.0.wrapping_add(1);
        splitmix64(self.0) % limit
    }

    /// An integer of `min..=max`.
    pub fn between(&mut self, min: i64, max: i64) -> i64 {
        min + self.below((max - min + 1) as u64) as i64
    }

    pub fn codes(&mut self, count: usize, min: i64, max: i64) -> Vec<f64> {
        (0..count).map(|_| self.between(min, max) as f64).collect()
    }

    /// A real number of `min..max`.
    pub fn real(&mut self, min: f64, max: f64) -> f64 {
        min + (max - min) * self.below(1 << 40) as f64 / f64::from(1u32 << 20).powi(2)
    }

    pub fn reals(&mut self, count: usize, min: f64, max: f64) -> Vec<f64> {
        (0..count).map(|_| self.real(min, max)).collect()
    }

    pub fn vec<T: TryFrom<i64, Error: std::fmt::Debug>>(&mut self, count: usize, min: i64, max: i64) -> Vec<T> {
        (0..count).map(|_| T::try_from(self.between(min, max)).unwrap()).collect()
    }
}

/// The finalizer of the SplitMix64 generator, used as a counter-based random function.
fn splitmix64(state: u64) -> u64 {
    let z = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}
