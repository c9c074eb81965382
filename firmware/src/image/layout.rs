//! Named byte ranges of the image file: the one place that knows where a field lies. The reader ([`super::Image`]) and
//! the compiler's writer both use these constants.

use crate::tensor::index;
use core::ops::Range;

/// First eight bytes of every image. The first byte is not ASCII and the tail catches line-end conversion.
pub const MAGIC: [u8; 8] = *b"\x93DRIVE\r\n";
/// The format that this crate reads and writes.
pub const FORMAT: u16 = 1;
/// Base address, sections, constant ranges and tensors are aligned to this many bytes.
pub const ALIGNMENT: usize = 16;

/// Offsets in a region are multiples of this: the widest element that the operators view there.
pub const ARENA_OFFSET_ALIGNMENT: usize = 4;
/// Largest number of steps.
pub const MAX_STEPS: u16 = 2048;
/// Largest number of tensor records.
pub const MAX_TENSORS: u16 = 4096;
/// Largest number of inputs and of outputs, each.
pub const MAX_PORTS: u8 = 16;
/// Largest alignment of a region.
pub const MAX_ARENA_ALIGNMENT: u32 = 4096;
/// Largest work of one inference, in elementary operations (about an hour on one fast core).
pub const MAX_WORK: u64 = 1 << 42;

/// The header: fixed size, at the start of the file.
pub mod header {
    use super::Range;

    /// [`super::MAGIC`].
    pub const MAGIC: Range<usize> = 0..8;
    /// `u16`: [`super::FORMAT`].
    pub const FORMAT: Range<usize> = 8..10;
    /// `u16`: number of steps.
    pub const STEP_COUNT: Range<usize> = 10..12;
    /// `u32`: length of the file.
    pub const TOTAL_BYTES: Range<usize> = 12..16;
    /// `u64`: a bit per step kind ([`crate::program::Step::feature`]) and per kernel
    /// ([`crate::program::KernelId::feature`]) that the program uses.
    pub const FEATURES: Range<usize> = 16..24;
    /// `u16`: number of tensor records.
    pub const TENSOR_COUNT: Range<usize> = 24..26;
    /// `u8`: number of inputs.
    pub const INPUT_COUNT: Range<usize> = 26..27;
    /// `u8`: number of outputs.
    pub const OUTPUT_COUNT: Range<usize> = 27..28;
    /// `u8`: number of memory regions, 1..=[`super::REGION_SLOTS`].
    pub const REGION_COUNT: Range<usize> = 28..29;
    /// Zero.
    pub const RESERVED_A: Range<usize> = 29..32;
    /// Model name, UTF-8, padded with zeros.
    pub const NAME: Range<usize> = 32..64;
    /// SHA-256 of the quantized model; all zero where unknown.
    pub const QMODEL_DIGEST: Range<usize> = 64..96;
    /// Digest that names the build; all zero where unknown.
    pub const BUILD_DIGEST: Range<usize> = 96..128;
    /// [`super::REGION_SLOTS`] region slots ([`super::region`]); unused ones are zero.
    pub const REGIONS: Range<usize> = 128..192;
    /// [`super::SECTION_SLOTS`] section slots ([`super::section`]); unused ones are zero.
    pub const SECTIONS: Range<usize> = 192..320;
    /// Name of the target that the image was compiled for, visible ASCII, padded with zeros; all zero where unknown.
    pub const TARGET: Range<usize> = 320..336;
    /// `u32`: revision of the model; [`crate::update`] refuses to go back.
    pub const REVISION: Range<usize> = 336..340;
    /// Zero.
    pub const RESERVED_B: Range<usize> = 340..380;
    /// `u32`: CRC-32 of all header bytes before it.
    pub const CRC: Range<usize> = 380..384;
    /// Size of the header.
    pub const BYTES: usize = 384;
}

/// Region slots in the header.
pub const REGION_SLOTS: usize = 4;

/// One slot of [`header::REGIONS`].
pub mod region {
    use super::Range;

    /// Name, visible ASCII, padded with zeros (`main`); no two regions have the same.
    pub const NAME: Range<usize> = 0..NAME_BYTES;
    /// `u32`: bytes of the arena that the caller provides there. Those of all regions are less than 2^32.
    pub const ARENA_BYTES: Range<usize> = 8..12;
    /// `u32`: alignment of these bytes; a power of two, 16..=4096.
    pub const ALIGNMENT: Range<usize> = 12..16;
    /// Size of a slot.
    pub const BYTES: usize = 16;
    /// Size of a name.
    pub const NAME_BYTES: usize = 8;
}

/// Section slots in the header.
pub const SECTION_SLOTS: usize = 8;
/// Sections of this format, in file order; slot and position agree.
pub const SECTIONS: usize = 6;

/// One slot of [`header::SECTIONS`]. Sections follow each other without gaps from [`header::BYTES`]; each is padded
/// with zeros to a multiple of 16.
pub mod section {
    use super::Range;

    /// `u32`: [`super::super::SectionKind`] as a number.
    pub const KIND: Range<usize> = 0..4;
    /// `u32`: first byte in the file.
    pub const OFFSET: Range<usize> = 4..8;
    /// `u32`: length without padding.
    pub const LENGTH: Range<usize> = 8..12;
    /// `u32`: CRC-32 of the section with its padding.
    pub const CRC: Range<usize> = 12..16;
    /// Size of a slot.
    pub const BYTES: usize = 16;
}

/// One record of the ports section: inputs first, then outputs.
pub mod port {
    use super::Range;

    /// `u16`: tensor.
    pub const TENSOR: Range<usize> = 0..2;
    /// `i16`: zero point.
    pub const ZERO_POINT: Range<usize> = 2..4;
    /// `f32` bits: scale; metadata, never computed with.
    pub const SCALE: Range<usize> = 4..8;
    /// Name, UTF-8, padded with zeros.
    pub const NAME: Range<usize> = 8..32;
    /// Size of a record.
    pub const BYTES: usize = 32;
}

/// One record of the tensors section.
pub mod tensor {
    use super::Range;

    /// `u8`: region, a slot of [`super::header::REGIONS`].
    pub const REGION: Range<usize> = 0..1;
    /// `u8`: [`crate::tensor::ElementType`].
    pub const ELEMENT: Range<usize> = 1..2;
    /// `u16`: tensor whose memory this one takes over, or [`NOT_IN_PLACE`].
    pub const IN_PLACE_OF: Range<usize> = 2..4;
    /// `u32`: first byte in the region, a multiple of 4.
    pub const OFFSET: Range<usize> = 4..8;
    /// `u32`: length.
    pub const LENGTH: Range<usize> = 8..12;
    /// `u16`: batch; 1 (0 for scratch).
    pub const BATCH: Range<usize> = 12..14;
    /// `u16`: height (0 for scratch).
    pub const HEIGHT: Range<usize> = 14..16;
    /// `u16`: width (0 for scratch).
    pub const WIDTH: Range<usize> = 16..18;
    /// `u16`: channels (0 for scratch).
    pub const CHANNELS: Range<usize> = 18..20;
    /// `u16`: step that writes it; 0 for inputs.
    pub const FIRST_STEP: Range<usize> = 20..22;
    /// `u16`: last step that reads it; the last step of the program for outputs.
    pub const LAST_STEP: Range<usize> = 22..24;
    /// Zero.
    pub const RESERVED: Range<usize> = 24..32;
    /// Size of a record.
    pub const BYTES: usize = 32;
    /// Value of [`IN_PLACE_OF`] for a tensor with memory of its own.
    pub const NOT_IN_PLACE: u16 = 0xFFFF;
}

/// The step index: `u32` per step, its first byte in the program section.
pub mod step_index {
    /// Size of an entry.
    pub const BYTES: usize = 4;
}

/// The known-answer section: a seed, then `u32` per step, the CRC-32 of the step's output bytes.
pub mod known_answer {
    use super::Range;

    /// `u64`: seed of the input rule.
    pub const SEED: Range<usize> = 0..8;
    /// Where the CRCs begin.
    pub const CRCS: usize = 8;
    /// Size of one CRC.
    pub const CRC_BYTES: usize = 4;
}

/// Length of the image that begins with these bytes, as its header states it; `None` where no image begins.
pub const fn stated_length(bytes: &[u8]) -> Option<usize> {
    let Some((_, rest)) = bytes.split_at_checked(header::TOTAL_BYTES.start) else { return None };
    match (bytes.first_chunk(), rest.first_chunk()) {
        (Some(magic), Some(total)) if u64::from_le_bytes(*magic) == u64::from_le_bytes(MAGIC) => {
            Some(index(u32::from_le_bytes(*total)))
        }
        _ => None,
    }
}

/// `length` rounded up to a multiple of [`ALIGNMENT`].
pub fn padded(length: u64) -> u64 {
    length.checked_next_multiple_of(ALIGNMENT as u64).unwrap_or(u64::MAX)
}
