//! Constants of an ONNX file: decoded initializers and attributes, and the few rearrangements that folding needs.

use super::external::Folder;
use super::proto::{self, element};
use crate::error::{Error, ErrorCode, Result};
use crate::import::checkpoint::malformed;
use crate::import::checkpoint::{DType, TensorData, decode};
use std::sync::Arc;

/// A constant.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Tensor {
    /// Extents, outermost first; empty for a scalar.
    pub(super) dims: Vec<usize>,
    /// Row-major, as many as the extents say.
    pub(super) data: Arc<TensorData>,
}

impl Tensor {
    pub(super) fn new(dims: Vec<usize>, data: TensorData) -> Self {
        Self { dims, data: Arc::new(data) }
    }

    /// A list of integers.
    pub(super) fn integers(values: Vec<i64>) -> Self {
        Self::new(vec![values.len()], TensorData::Integer(values))
    }

    pub(super) fn len(&self) -> usize {
        self.data.len()
    }

    /// What a message calls the element type.
    pub(super) fn kind(&self) -> &'static str {
        match *self.data {
            TensorData::Float(_) => "floating",
            TensorData::Integer(_) => "integer",
        }
    }

    /// The elements at `indices` of one axis; all in range.
    pub(super) fn select(&self, axis: usize, indices: &[usize]) -> Self {
        let mut dims = self.dims.clone();
        dims[axis] = indices.len();
        if self.len() == 0 {
            return Self { dims, ..self.clone() };
        }
        let inner: usize = self.dims[axis + 1..].iter().product();
        let extent = self.dims[axis];
        let outer: usize = self.dims[..axis].iter().product();
        let runs = (0..outer).flat_map(|o| indices.iter().map(move |i| (o * extent + i) * inner));
        let data = match &*self.data {
            TensorData::Float(v) => TensorData::Float(runs.flat_map(|at| &v[at..at + inner]).copied().collect()),
            TensorData::Integer(v) => TensorData::Integer(runs.flat_map(|at| &v[at..at + inner]).copied().collect()),
        };
        Self::new(dims, data)
    }

    /// Axis `i` of the result is axis `permutation[i]` of this tensor.
    pub(super) fn transpose(&self, permutation: &[usize]) -> Self {
        let dims: Vec<usize> = permutation.iter().map(|&axis| self.dims[axis]).collect();
        if self.len() == 0 {
            return Self { dims, ..self.clone() };
        }
        let stride = |axis: usize| self.dims[axis + 1..].iter().product::<usize>();
        let strides: Vec<usize> = permutation.iter().map(|&axis| stride(axis)).collect();
        let source = |mut index: usize| {
            let mut at = 0;
            for (extent, stride) in dims.iter().zip(&strides).rev() {
                at += index % extent * stride;
                index /= extent;
            }
            at
        };
        let sources = (0..self.len()).map(source);
        let data = match &*self.data {
            TensorData::Float(v) => TensorData::Float(sources.map(|at| v[at]).collect()),
            TensorData::Integer(v) => TensorData::Integer(sources.map(|at| v[at]).collect()),
        };
        Self::new(dims, data)
    }
}

/// The number of elements of these extents, if it is a number.
pub(super) fn elements(dims: &[usize]) -> Option<usize> {
    dims.iter().try_fold(1usize, |count, &extent| count.checked_mul(extent))
}

/// Extents that are no negative numbers, and their product.
fn extents(dims: &[i64]) -> Result<(Vec<usize>, usize)> {
    let sizes: Option<Vec<usize>> = dims.iter().map(|&d| usize::try_from(d).ok()).collect();
    let known = sizes.and_then(|sizes| elements(&sizes).map(|count| (sizes, count)));
    known.ok_or_else(|| malformed("", format!("found extents {dims:?}, expected sizes")))
}

/// Decodes a constant; the place of errors is the caller's.
///
/// # Errors
/// The element type is not read, or there are more or fewer elements than the extents say.
pub(super) fn read(proto: &proto::Tensor, folder: &Folder<'_>) -> Result<Tensor> {
    let dtype = match proto.data_type {
        element::FLOAT => DType::F32,
        element::DOUBLE => DType::F64,
        element::FLOAT16 => DType::F16,
        element::BFLOAT16 => DType::BF16,
        element::INT64 => DType::I64,
        element::INT32 => DType::I32,
        element::INT16 => DType::I16,
        element::INT8 => DType::I8,
        element::UINT8 => DType::U8,
        element::BOOL => DType::Bool,
        other => {
            let message = format!("element type {} is not read", element::name(other));
            return Err(Error::new(ErrorCode::Unsupported, "", message)
                .with_help("read are float, double, float16, bfloat16, int64, int32, int16, int8, uint8, bool"));
        }
    };
    let (dims, count) = extents(&proto.dims)?;
    let data = if proto.data_location == proto::EXTERNAL {
        decode(dtype, &folder.read(&proto.external_data, count.checked_mul(dtype.bytes()))?)
    } else if !proto.raw_data.is_empty() {
        if Some(proto.raw_data.len()) != count.checked_mul(dtype.bytes()) {
            let (found, name) = (proto.raw_data.len(), element::name(proto.data_type));
            return Err(malformed("", format!("found {found} bytes, expected {count} elements of type {name}")));
        }
        decode(dtype, &proto.raw_data)
    } else {
        listed(dtype, proto)
    };
    if data.len() != count {
        return Err(malformed("", format!("found {} elements, expected {count} (extents {dims:?})", data.len())));
    }
    Ok(Tensor::new(dims, data))
}

/// Elements from the list that belongs to their type.
fn listed(dtype: DType, proto: &proto::Tensor) -> TensorData {
    let integers = || proto.int32_data.iter().map(|&v| i64::from(v));
    match dtype {
        DType::F32 => TensorData::Float(proto.float_data.clone()),
        DType::F64 => TensorData::Float(proto.double_data.iter().map(|&v| v as f32).collect()),
        DType::F16 | DType::BF16 => {
            let bits: Vec<u8> = proto.int32_data.iter().flat_map(|&v| (v as u16).to_le_bytes()).collect();
            decode(dtype, &bits)
        }
        DType::I64 => TensorData::Integer(proto.int64_data.clone()),
        DType::Bool => TensorData::Integer(integers().map(|v| i64::from(v != 0)).collect()),
        DType::I32 | DType::I16 | DType::I8 | DType::U8 => TensorData::Integer(integers().collect()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use prost::bytes::Bytes;

    fn read_alone(proto: &proto::Tensor) -> Result<Tensor> {
        read(proto, &Folder::none())
    }

    fn floats(values: &[f32]) -> TensorData {
        TensorData::Float(values.to_vec())
    }

    #[test]
    fn raw_and_listed_elements_agree_for_every_type() {
        let with = |data_type: i32, proto: proto::Tensor| proto::Tensor { dims: vec![2], data_type, ..proto };
        let raw = |bytes: &[u8]| proto::Tensor { raw_data: Bytes::copy_from_slice(bytes), ..Default::default() };
        let words = |values: [i32; 2]| proto::Tensor { int32_data: values.to_vec(), ..Default::default() };
        let integers = |a: i64, b: i64| TensorData::Integer(vec![a, b]);
        for (element, raw, listed, expected) in [
            (
                element::FLOAT,
                raw(&[1.5f32, -2.0].map(f32::to_le_bytes).concat()),
                proto::Tensor { float_data: vec![1.5, -2.0], ..Default::default() },
                floats(&[1.5, -2.0]),
            ),
            (
                element::DOUBLE,
                raw(&[1.5f64, -2.0].map(f64::to_le_bytes).concat()),
                proto::Tensor { double_data: vec![1.5, -2.0], ..Default::default() },
                floats(&[1.5, -2.0]),
            ),
            (element::FLOAT16, raw(&[0, 0x3c, 0, 0xc0]), words([0x3c00, 0xc000]), floats(&[1.0, -2.0])),
            (element::BFLOAT16, raw(&[0x80, 0x3f, 0, 0xc0]), words([0x3f80, 0xc000]), floats(&[1.0, -2.0])),
            (
                element::INT64,
                raw(&[-3i64, i64::MAX].map(i64::to_le_bytes).concat()),
                proto::Tensor { int64_data: vec![-3, i64::MAX], ..Default::default() },
                integers(-3, i64::MAX),
            ),
            (element::INT32, raw(&[-3i32, 7].map(i32::to_le_bytes).concat()), words([-3, 7]), integers(-3, 7)),
            (element::INT16, raw(&[-3i16, 7].map(i16::to_le_bytes).concat()), words([-3, 7]), integers(-3, 7)),
            (element::INT8, raw(&[0xfd, 7]), words([-3, 7]), integers(-3, 7)),
            (element::UINT8, raw(&[0xfd, 7]), words([253, 7]), integers(253, 7)),
            (element::BOOL, raw(&[0, 1]), words([0, 1]), integers(0, 1)),
        ] {
            let name = element::name(element);
            assert_eq!(*read_alone(&with(element, raw)).unwrap().data, expected, "{name}, raw");
            assert_eq!(*read_alone(&with(element, listed)).unwrap().data, expected, "{name}, listed");
        }
    }

    #[test]
    fn lengths_that_do_not_fit_the_extents_are_refused() {
        let tensor = |dims: &[i64], raw: &'static [u8]| proto::Tensor {
            dims: dims.to_vec(),
            data_type: element::FLOAT,
            raw_data: Bytes::from_static(raw),
            ..Default::default()
        };
        for (proto, message) in [
            (tensor(&[2], &[0; 4]), "found 4 bytes, expected 2 elements of type float"),
            (tensor(&[2], &[]), "found 0 elements, expected 2 (extents [2])"),
            (tensor(&[-1], &[0; 4]), "found extents [-1], expected sizes"),
            (tensor(&[i64::MAX, 4], &[0; 4]), "found extents [9223372036854775807, 4], expected sizes"),
            (tensor(&[i64::MAX], &[0; 4]), "found 4 bytes, expected 9223372036854775807 elements of type float"),
            (proto::Tensor { data_type: 8, ..Default::default() }, "element type string is not read"),
            (proto::Tensor { data_type: -1, ..Default::default() }, "element type element type -1 is not read"),
        ] {
            assert_eq!(read_alone(&proto).unwrap_err().message, message);
        }
    }

    #[test]
    fn select_and_transpose_follow_the_axes() {
        let matrix = Tensor::new(vec![2, 3], floats(&[0.0, 1.0, 2.0, 3.0, 4.0, 5.0]));
        assert_eq!(matrix.select(1, &[2, 0]), Tensor::new(vec![2, 2], floats(&[2.0, 0.0, 5.0, 3.0])));
        assert_eq!(matrix.select(0, &[1]), Tensor::new(vec![1, 3], floats(&[3.0, 4.0, 5.0])));
        let transposed = matrix.transpose(&[1, 0]);
        assert_eq!(transposed, Tensor::new(vec![3, 2], floats(&[0.0, 3.0, 1.0, 4.0, 2.0, 5.0])));
        assert_eq!(transposed.transpose(&[1, 0]), matrix);
    }
}
