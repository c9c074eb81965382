//! Safetensors: an eight-byte header length, a JSON header, the tensors.
//!
//! The crate parses the header and proves that the tensors follow each other without gap or overlap. The lengths around
//! it are checked here, where sums cannot wrap and the message can say what is missing.

use safetensors::Dtype;
use safetensors::tensor::{Metadata, TensorInfo};

use crate::error::{Error, ErrorCode, Result};

use super::element::{DType, decode};
use super::tensor_view::element_count;
use super::{Contents, NamedTensor, malformed, quoted};

/// Reads a safetensors file.
pub(super) fn parse(bytes: &[u8]) -> Result<Contents> {
    let (header, data) = split(bytes)?;
    let metadata: Metadata = serde_json::from_slice(header).map_err(|error| {
        let expected =
            "expected tensors whose data_offsets follow each other without gap or overlap and fit shape and dtype";
        malformed("header", format!("found {error}; {expected}"))
    })?;
    if metadata.data_len() != data.len() {
        let message = format!("found {} bytes, expected {} as in the header", data.len(), metadata.data_len());
        return Err(malformed("tensor data", message));
    }
    let by_name = metadata.tensors();
    let mut infos: Vec<(&String, &&TensorInfo)> = by_name.iter().collect();
    // Tensors without elements share offsets; their names give them one order.
    infos.sort_by_key(|(name, info)| (info.data_offsets, *name));
    let tensors = infos.into_iter().map(|(name, info)| tensor(name, info, data)).collect::<Result<_>>()?;
    Ok(Contents { tensors, skipped: Vec::new() })
}

/// Header and tensor data.
fn split(bytes: &[u8]) -> Result<(&[u8], &[u8])> {
    let Some((length, rest)) = bytes.split_first_chunk() else {
        return Err(malformed("byte 0", format!("found {} bytes, expected a header length of 8", bytes.len())));
    };
    let length = u64::from_le_bytes(*length);
    let split = usize::try_from(length).ok().and_then(|length| rest.split_at_checked(length));
    split.ok_or_else(|| {
        malformed("byte 8 (header)", format!("found {} bytes before the end, expected {length} of header", rest.len()))
    })
}

fn tensor(name: &str, info: &TensorInfo, data: &[u8]) -> Result<NamedTensor> {
    let place = || format!("tensor {}", quoted(name));
    let Some(dtype) = dtype(info.dtype) else {
        let message =
            format!("found element type {}, expected a float of 16 to 64 bits, an integer or bool", info.dtype);
        return Err(Error::new(ErrorCode::Unsupported, place(), message)
            .with_help("convert the tensor to float32 before saving"));
    };
    element_count(&info.shape).ok_or_else(|| malformed(place(), format!("found the shape {:?}", info.shape)))?;
    let (start, end) = info.data_offsets;
    let bytes = data.get(start..end).ok_or_else(|| malformed(place(), format!("found offsets {start}..{end}")))?;
    Ok(NamedTensor { name: name.to_owned(), shape: info.shape.clone(), dtype, data: decode(dtype, bytes) })
}

fn dtype(dtype: Dtype) -> Option<DType> {
    Some(match dtype {
        Dtype::F64 => DType::F64,
        Dtype::F32 => DType::F32,
        Dtype::F16 => DType::F16,
        Dtype::BF16 => DType::BF16,
        Dtype::I64 => DType::I64,
        Dtype::I32 => DType::I32,
        Dtype::I16 => DType::I16,
        Dtype::I8 => DType::I8,
        Dtype::U8 => DType::U8,
        Dtype::BOOL => DType::Bool,
        _ => return None,
    })
}
