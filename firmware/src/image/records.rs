//! Fixed-size records of the tables: tensors and ports.

use super::bytes::{self, put};
use super::layout::{port, tensor};
use crate::tensor::{ElementType, Shape, TensorId};

/// One tensor or scratch buffer of the arena.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TensorRecord {
    /// Element type; `Scratch` for working memory.
    pub element: ElementType,
    /// Shape; all zero for scratch.
    pub shape: Shape,
    /// Memory region, by its position in the header.
    pub region: u8,
    /// First byte in the region, a multiple of 4.
    pub offset: u32,
    /// Length in bytes, without rounding.
    pub bytes: u32,
    /// Step that writes it; 0 for inputs.
    pub first_step: u16,
    /// Last step that reads it; the program's last step for outputs.
    pub last_step: u16,
    /// Tensor whose memory the writing step takes over.
    pub in_place_of: Option<TensorId>,
}

impl TensorRecord {
    /// Working memory of one step, in the first region.
    pub const fn scratch(offset: u32, bytes: u32, step: u16) -> Self {
        Self {
            element: ElementType::Scratch,
            shape: Shape { height: 0, width: 0, channels: 0 },
            region: 0,
            offset,
            bytes,
            first_step: step,
            last_step: step,
            in_place_of: None,
        }
    }

    /// First byte behind the tensor.
    pub const fn end(&self) -> u64 {
        (self.offset as u64).saturating_add(self.bytes as u64)
    }

    /// Whether two buffers share a byte of the arena.
    pub const fn overlaps(&self, other: &Self) -> bool {
        self.region == other.region && (self.offset as u64) < other.end() && (other.offset as u64) < self.end()
    }

    /// Whether the buffer holds something at this step.
    pub const fn is_live(&self, step: u16) -> bool {
        self.first_step <= step && step <= self.last_step
    }

    /// The stored form.
    pub fn to_bytes(&self) -> [u8; tensor::BYTES] {
        let mut record = [0; tensor::BYTES];
        let batch = if self.element == ElementType::Scratch { 0_u16 } else { 1 };
        let in_place_of = self.in_place_of.map_or(tensor::NOT_IN_PLACE, |id| id.0);
        put(&mut record, tensor::REGION, &[self.region]);
        put(&mut record, tensor::ELEMENT, &[self.element as u8]);
        put(&mut record, tensor::IN_PLACE_OF, &in_place_of.to_le_bytes());
        put(&mut record, tensor::OFFSET, &self.offset.to_le_bytes());
        put(&mut record, tensor::LENGTH, &self.bytes.to_le_bytes());
        put(&mut record, tensor::BATCH, &batch.to_le_bytes());
        put(&mut record, tensor::HEIGHT, &self.shape.height.to_le_bytes());
        put(&mut record, tensor::WIDTH, &self.shape.width.to_le_bytes());
        put(&mut record, tensor::CHANNELS, &self.shape.channels.to_le_bytes());
        put(&mut record, tensor::FIRST_STEP, &self.first_step.to_le_bytes());
        put(&mut record, tensor::LAST_STEP, &self.last_step.to_le_bytes());
        record
    }

    /// Reads a stored record; `None` for an unknown element type or too few bytes. Fields are not judged.
    pub fn from_bytes(record: &[u8]) -> Option<Self> {
        let in_place_of = bytes::u16_at(record, tensor::IN_PLACE_OF)?;
        Some(Self {
            element: ElementType::from_code(bytes::u8_at(record, tensor::ELEMENT)?)?,
            shape: Shape {
                height: bytes::u16_at(record, tensor::HEIGHT)?,
                width: bytes::u16_at(record, tensor::WIDTH)?,
                channels: bytes::u16_at(record, tensor::CHANNELS)?,
            },
            region: bytes::u8_at(record, tensor::REGION)?,
            offset: bytes::u32_at(record, tensor::OFFSET)?,
            bytes: bytes::u32_at(record, tensor::LENGTH)?,
            first_step: bytes::u16_at(record, tensor::FIRST_STEP)?,
            last_step: bytes::u16_at(record, tensor::LAST_STEP)?,
            in_place_of: (in_place_of != tensor::NOT_IN_PLACE).then_some(TensorId(in_place_of)),
        })
    }
}

/// An input or output of the network: `real = scale · (code − zero_point)`.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Port<'a> {
    /// Name (`rgb`, `bev`, `velocity`, `goal`, `waypoints`, …); at most 24 bytes of UTF-8.
    pub name: &'a str,
    /// The tensor.
    pub tensor: TensorId,
    /// Scale, positive. For the host and telemetry; the runtime never computes with it.
    pub scale: f32,
    /// Zero point; 0 for 16 and 32 bit.
    pub zero_point: i16,
}

impl<'a> Port<'a> {
    /// The stored form; `None` if the name is longer than its field.
    pub fn to_bytes(&self) -> Option<[u8; port::BYTES]> {
        let mut record = [0; port::BYTES];
        put(&mut record, port::TENSOR, &self.tensor.0.to_le_bytes());
        put(&mut record, port::ZERO_POINT, &self.zero_point.to_le_bytes());
        put(&mut record, port::SCALE, &self.scale.to_bits().to_le_bytes());
        record.get_mut(port::NAME)?.get_mut(..self.name.len())?.copy_from_slice(self.name.as_bytes());
        Some(record)
    }

    /// Reads a stored record; `None` for too few bytes or a name that [`text`] refuses.
    pub fn from_bytes(record: &'a [u8]) -> Option<Self> {
        Some(Self {
            name: text(record.get(port::NAME)?)?,
            tensor: TensorId(bytes::u16_at(record, port::TENSOR)?),
            scale: f32::from_bits(bytes::u32_at(record, port::SCALE)?),
            zero_point: bytes::u16_at(record, port::ZERO_POINT)?.cast_signed(),
        })
    }
}

/// The text of a fixed-size field: UTF-8, then only zeros. `None` otherwise.
pub fn text(field: &[u8]) -> Option<&str> {
    let length = field.iter().position(|byte| *byte == 0).unwrap_or(field.len());
    let (name, padding) = field.split_at_checked(length)?;
    padding.iter().all(|byte| *byte == 0).then_some(core::str::from_utf8(name).ok()).flatten()
}
