//! What is handed over, in C's layout.

use crate::image::{Image, Port, TensorRecord, layout};
use crate::tensor::ElementType;
use crate::waypoint::Waypoint;
use core::ffi::{c_char, c_void};

/// Words of an engine's storage.
pub const ENGINE_WORDS: usize = 48;
/// Most memory regions of an image.
pub const MAX_REGIONS: usize = 4;
/// Most waypoints of an output.
pub const MAX_WAYPOINTS: usize = 16;
/// Bytes of a model's name with the zero behind it.
pub const MODEL_NAME_BYTES: usize = 33;
/// Bytes of a port's name with the zero behind it.
pub const PORT_NAME_BYTES: usize = 25;

const _: () = assert!(MAX_REGIONS == layout::REGION_SLOTS);
const _: () = assert!(MAX_WAYPOINTS == crate::waypoint::MAX_WAYPOINTS);
const _: () = assert!(MODEL_NAME_BYTES == layout::header::NAME.end - layout::header::NAME.start + 1);
const _: () = assert!(PORT_NAME_BYTES == layout::port::NAME.end - layout::port::NAME.start + 1);

/// Storage of an engine: the caller's, as static or automatic storage, filled with zeros. `fw_engine_init` sets it up;
/// what it holds is the library's business. It must not be moved or copied while it is in use.
#[derive(Debug)]
#[repr(C)]
pub struct EngineStorage {
    /// Not to be touched.
    pub state: [u64; ENGINE_WORDS],
}

/// Memory that an engine works in.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Region {
    /// First byte, aligned as `fw_image_info` says for the region of this index.
    pub memory: *mut c_void,
    /// Its bytes: at least as many as `fw_image_info` says.
    pub bytes: usize,
}

/// An input's bytes.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Bytes {
    /// First byte.
    pub data: *const c_void,
    /// Number of bytes.
    pub bytes: usize,
}

/// Memory that an image asks for.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct RegionNeed {
    /// Bytes.
    pub bytes: u32,
    /// Alignment of the first byte: a power of two, 16 to 4096.
    pub alignment: u32,
}

/// What an image is and what it asks for.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct ImageInfo {
    /// Name of the model, UTF-8.
    pub name: [c_char; MODEL_NAME_BYTES],
    /// SHA-256 of the quantized model, all zero where unknown.
    pub model_digest: [u8; 32],
    /// Digest that names the build, all zero where unknown.
    pub build_digest: [u8; 32],
    /// Multiply-accumulates and elements touched in one inference.
    pub work: u64,
    /// Steps of one inference.
    pub steps: u32,
    /// Inputs of the network.
    pub inputs: u32,
    /// Outputs of the network.
    pub outputs: u32,
    /// Regions that an engine needs.
    pub region_count: u32,
    /// What each has to be; zeros behind the last.
    pub regions: [RegionNeed; MAX_REGIONS],
}

/// Type of the elements of an input or output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
pub enum Element {
    /// Signed 8-bit codes: `real = scale * (code - zero_point)`.
    I8 = 0,
    /// Signed 16-bit codes, zero point 0.
    I16 = 1,
    /// Signed 32-bit words, zero point 0.
    I32 = 2,
}

/// An input or output of the network: `height * width * channels` elements, channel fastest, little-endian.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct PortInfo {
    /// Name, UTF-8: `rgb`, `bev`, `velocity`, `goal`, `waypoints` and others.
    pub name: [c_char; PORT_NAME_BYTES],
    /// Type of the elements.
    pub element: Element,
    /// Rows.
    pub height: u16,
    /// Columns.
    pub width: u16,
    /// Channels.
    pub channels: u16,
    /// Code of the real number 0.
    pub zero_point: i16,
    /// Real step of one code. The library does not compute with it.
    pub scale: f32,
    /// Bytes of the tensor.
    pub bytes: u32,
}

/// How far an inference is: outputs can be read when `done == steps`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct ProgressInfo {
    /// Steps done.
    pub done: u32,
    /// Steps in all.
    pub steps: u32,
}

/// Where to be, half a second after the waypoint before (the first: half a second from now), in the vehicle's frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct WaypointQ16 {
    /// To the right, in 1/65536 m.
    pub right: i32,
    /// Ahead, in 1/65536 m.
    pub forward: i32,
}

impl From<&Image<'_>> for ImageInfo {
    fn from(image: &Image<'_>) -> Self {
        let mut regions = [RegionNeed::default(); MAX_REGIONS];
        for (need, region) in regions.iter_mut().zip(image.regions()) {
            *need = RegionNeed { bytes: region.bytes, alignment: region.alignment };
        }
        Self {
            name: text(image.name()),
            model_digest: image.qmodel_digest(),
            build_digest: image.build_digest(),
            work: image.work(),
            steps: image.step_count().into(),
            inputs: image.input_count().into(),
            outputs: image.output_count().into(),
            region_count: image.region_count().into(),
            regions,
        }
    }
}

impl PortInfo {
    /// The port of a tensor; `None` for scratch, which `Image::parse` does not let be one.
    pub(super) fn new(port: &Port<'_>, record: &TensorRecord) -> Option<Self> {
        let element = match record.element {
            ElementType::I8 => Element::I8,
            ElementType::I16 => Element::I16,
            ElementType::I32 => Element::I32,
            ElementType::Scratch => return None,
        };
        Some(Self {
            name: text(port.name),
            element,
            height: record.shape.height,
            width: record.shape.width,
            channels: record.shape.channels,
            zero_point: port.zero_point,
            scale: port.scale,
            bytes: record.bytes,
        })
    }
}

impl From<&Waypoint> for WaypointQ16 {
    fn from(waypoint: &Waypoint) -> Self {
        Self { right: waypoint.right.to_bits(), forward: waypoint.forward.to_bits() }
    }
}

/// A name with zeros behind it; the last byte is always zero.
fn text<const BYTES: usize>(name: &str) -> [c_char; BYTES] {
    let mut field = [0; BYTES];
    for (place, byte) in field.iter_mut().take(BYTES.saturating_sub(1)).zip(name.bytes()) {
        *place = c_char::from_ne_bytes([byte]);
    }
    field
}
