//! Element types of checkpoint files and their conversion.

/// Element type in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DType {
    /// IEEE 754 binary64.
    F64,
    /// IEEE 754 binary32.
    F32,
    /// IEEE 754 binary16.
    F16,
    /// The upper half of a binary32.
    BF16,
    /// Signed 64-bit integer.
    I64,
    /// Signed 32-bit integer.
    I32,
    /// Signed 16-bit integer.
    I16,
    /// Signed 8-bit integer.
    I8,
    /// Unsigned 8-bit integer.
    U8,
    /// A byte, zero for false.
    Bool,
}

impl DType {
    /// Bytes of an element.
    pub fn bytes(self) -> usize {
        match self {
            Self::F64 | Self::I64 => 8,
            Self::F32 | Self::I32 => 4,
            Self::F16 | Self::BF16 | Self::I16 => 2,
            Self::I8 | Self::U8 | Self::Bool => 1,
        }
    }

    /// Bytes of an element after conversion.
    pub(super) fn converted_bytes(self) -> usize {
        if self.is_float() { size_of::<f32>() } else { size_of::<i64>() }
    }

    /// Whether elements are converted to `f32` (otherwise to `i64`).
    pub fn is_float(self) -> bool {
        matches!(self, Self::F64 | Self::F32 | Self::F16 | Self::BF16)
    }

    /// Name for reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::F64 => "f64",
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::BF16 => "bf16",
            Self::I64 => "i64",
            Self::I32 => "i32",
            Self::I16 => "i16",
            Self::I8 => "i8",
            Self::U8 => "u8",
            Self::Bool => "bool",
        }
    }
}

/// Elements of a tensor, row-major.
#[derive(Clone, Debug, PartialEq)]
pub enum TensorData {
    /// From a floating type; `f64` is rounded to nearest.
    Float(Vec<f32>),
    /// From an integer type or `bool` (0 or 1).
    Integer(Vec<i64>),
}

impl TensorData {
    /// Number of elements.
    pub fn len(&self) -> usize {
        match self {
            Self::Float(values) => values.len(),
            Self::Integer(values) => values.len(),
        }
    }

    /// Whether there are no elements.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Converts little-endian elements; `bytes` holds a whole number of them.
pub(in crate::import) fn decode(dtype: DType, bytes: &[u8]) -> TensorData {
    match dtype {
        DType::F64 => floats(bytes, |element| f64::from_le_bytes(element) as f32),
        DType::F32 => floats(bytes, f32::from_le_bytes),
        DType::F16 => floats(bytes, |element| f16_to_f32(u16::from_le_bytes(element))),
        DType::BF16 => floats(bytes, |element| f32::from_bits(u32::from(u16::from_le_bytes(element)) << 16)),
        DType::I64 => integers(bytes, i64::from_le_bytes),
        DType::I32 => integers(bytes, |element| i64::from(i32::from_le_bytes(element))),
        DType::I16 => integers(bytes, |element| i64::from(i16::from_le_bytes(element))),
        DType::I8 => integers(bytes, |element| i64::from(i8::from_le_bytes(element))),
        DType::U8 => integers(bytes, |[element]: [u8; 1]| i64::from(element)),
        DType::Bool => integers(bytes, |[element]: [u8; 1]| i64::from(element != 0)),
    }
}

fn floats<const N: usize>(bytes: &[u8], convert: impl Fn([u8; N]) -> f32) -> TensorData {
    TensorData::Float(bytes.as_chunks().0.iter().map(|&element| convert(element)).collect())
}

fn integers<const N: usize>(bytes: &[u8], convert: impl Fn([u8; N]) -> i64) -> TensorData {
    TensorData::Integer(bytes.as_chunks().0.iter().map(|&element| convert(element)).collect())
}

/// Every binary16 value is a binary32 value, so this is exact.
fn f16_to_f32(half: u16) -> f32 {
    let sign = u32::from(half >> 15) << 31;
    let exponent = u32::from(half >> 10) & 0x1f;
    let fraction = u32::from(half) & 0x3ff;
    match exponent {
        // Zero and subnormals: fraction · 2^−24.
        0 => f32::from_bits(sign | (fraction as f32 * 2f32.powi(-24)).to_bits()),
        0x1f => f32::from_bits(sign | 0x7f80_0000 | fraction << 13),
        _ => f32::from_bits(sign | (exponent + 127 - 15) << 23 | fraction << 13),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A half's value by its definition, in arithmetic that shares nothing with the bit moves above.
    fn half_by_definition(half: u16) -> f64 {
        let sign = if half & 0x8000 == 0 { 1.0 } else { -1.0 };
        let exponent = i32::from(half >> 10 & 0x1f);
        let fraction = f64::from(half & 0x3ff) / 1024.0;
        match exponent {
            0 => sign * fraction * 2f64.powi(-14),
            31 if fraction == 0.0 => sign * f64::INFINITY,
            31 => f64::NAN,
            _ => sign * (1.0 + fraction) * 2f64.powi(exponent - 15),
        }
    }

    #[test]
    fn every_half_converts_exactly() {
        for half in 0..=u16::MAX {
            let (expected, found) = (half_by_definition(half), f64::from(f16_to_f32(half)));
            assert!(expected == found || expected.is_nan() && found.is_nan(), "{half:#06x}: {found}, not {expected}");
            assert_eq!(expected.is_sign_negative() && !expected.is_nan(), found.is_sign_negative() && !found.is_nan());
        }
    }

    #[test]
    fn every_type_converts() {
        let floats = |dtype, bytes: &[u8]| match decode(dtype, bytes) {
            TensorData::Float(values) => values,
            TensorData::Integer(_) => panic!("{dtype:?} is floating"),
        };
        let integers = |dtype, bytes: &[u8]| match decode(dtype, bytes) {
            TensorData::Integer(values) => values,
            TensorData::Float(_) => panic!("{dtype:?} is not floating"),
        };
        assert_eq!(
            floats(DType::F64, &[1.0f64 / 3.0, 1e300].map(f64::to_le_bytes).concat()),
            [1.0 / 3.0, f32::INFINITY]
        );
        assert_eq!(floats(DType::F32, &(-2.5f32).to_le_bytes()), [-2.5]);
        assert_eq!(floats(DType::F16, &[0x00, 0x3c, 0x00, 0xc0]), [1.0, -2.0]);
        assert_eq!(floats(DType::BF16, &[0x80, 0x3f, 0x20, 0xc0]), [1.0, -2.5]);
        assert_eq!(integers(DType::I64, &i64::MIN.to_le_bytes()), [i64::MIN]);
        assert_eq!(integers(DType::I32, &(-7i32).to_le_bytes()), [-7]);
        assert_eq!(integers(DType::I16, &(-7i16).to_le_bytes()), [-7]);
        assert_eq!(integers(DType::I8, &[0xff, 1]), [-1, 1]);
        assert_eq!(integers(DType::U8, &[0xff, 1]), [255, 1]);
        assert_eq!(integers(DType::Bool, &[0, 1, 2]), [0, 1, 1]);
    }
}
