//! Whether an image is one for this board.

use crate::image::layout::{self, header};
use crate::image::{CheckError, Image, ParseError, Port, text};
use crate::program::{KernelId, Step};
use crate::tensor::{ElementType, Shape};
use core::fmt;
use serde::{Deserialize, Serialize};

/// The target whose images run wherever memory and kernels suffice.
const PORTABLE: &str = "portable";

/// The name of a target as an image carries it: up to 16 bytes of visible ASCII, padded with zeros.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TargetName([u8; TARGET_BYTES]);

const TARGET_BYTES: usize = header::TARGET.end - header::TARGET.start;

impl From<&str> for TargetName {
    /// What is longer than the field is cut off.
    fn from(name: &str) -> Self {
        let mut field = [0; TARGET_BYTES];
        field.iter_mut().zip(name.bytes()).for_each(|(to, from)| *to = from);
        Self(field)
    }
}

impl fmt::Display for TargetName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match text(&self.0) {
            Some("") => f.write_str("unknown"),
            name => f.write_str(name.unwrap_or("illegible")),
        }
    }
}

/// What is announced of an image before it is sent: the fields of its header that decide.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Manifest {
    /// Length of the file.
    pub bytes: u32,
    /// Revision of the model.
    pub revision: u32,
    /// Features that the program uses.
    pub features: u64,
    /// Bytes of arena in each memory region.
    pub arenas: [u32; layout::REGION_SLOTS],
    /// CRC of the header, which tells images apart.
    pub header_crc: u32,
    /// Target that the image was compiled for.
    pub target: TargetName,
}

impl Manifest {
    /// The manifest of an image.
    pub fn of(image: &Image<'_>) -> Self {
        Self {
            bytes: u32::try_from(image.bytes().len()).unwrap_or(u32::MAX),
            revision: image.revision(),
            features: image.features(),
            arenas: [0, 1, 2, 3].map(|region| image.region(region).map_or(0, |region| region.bytes)),
            header_crc: image.header_crc(),
            target: image.target().into(),
        }
    }
}

/// What a board and its application need of an image.
#[derive(Clone, Copy)]
pub struct Requirements<'a> {
    /// Name of the board's target; an image that names another one than this or `portable`, or none, is foreign.
    pub target: &'a str,
    /// Kernels of the backend ([`crate::kernels::Kernels::supported`]).
    pub kernels: &'a [KernelId],
    /// Bytes of arena that the engine is given in each memory region, in the order of the image's.
    pub arenas: &'a [u32],
    /// Whether the application knows the inputs and outputs; see [`same_interface`].
    pub interface: &'a dyn Fn(&Image<'_>) -> bool,
}

impl fmt::Debug for Requirements<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { target, kernels, arenas, .. } = self;
        f.debug_struct("Requirements")
            .field("target", target)
            .field("kernels", kernels)
            .field("arenas", arenas)
            .finish_non_exhaustive()
    }
}

impl Requirements<'_> {
    /// Whether the announced image can run here.
    ///
    /// # Errors
    /// The first requirement that is not met.
    pub fn admit(&self, manifest: &Manifest) -> Result<(), Refusal> {
        let expected = TargetName::from(self.target);
        if manifest.target != expected && manifest.target != TargetName::from(PORTABLE) {
            return Err(Refusal::ForeignTarget { found: manifest.target, expected });
        }
        let unknown = manifest.features & !Step::KNOWN_FEATURES;
        if unknown != 0 {
            return Err(Refusal::Features(unknown));
        }
        let uses = |kernel: &&KernelId| manifest.features & kernel.feature() != 0;
        if let Some(kernel) = KernelId::ALL.iter().filter(uses).find(|kernel| !self.kernels.contains(kernel)) {
            return Err(Refusal::KernelMissing(*kernel));
        }
        for (region, needed) in (0_u8..).zip(manifest.arenas) {
            let found = self.arenas.get(usize::from(region)).copied().unwrap_or_default();
            if needed > found {
                return Err(Refusal::Arena { region, needed, found });
            }
        }
        Ok(())
    }

    /// Whether this image can run here.
    ///
    /// # Errors
    /// The first requirement that is not met.
    pub fn accept(&self, image: &Image<'_>) -> Result<(), Refusal> {
        self.admit(&Manifest::of(image))?;
        if (self.interface)(image) { Ok(()) } else { Err(Refusal::Interface) }
    }
}

/// Whether two images have the same inputs and outputs: names, types, shapes, scales and zero points.
pub fn same_interface(one: &Image<'_>, other: &Image<'_>) -> bool {
    let inputs = one.input_count().max(other.input_count());
    let outputs = one.output_count().max(other.output_count());
    (0..inputs).all(|number| known(one, one.input(number)) == known(other, other.input(number)))
        && (0..outputs).all(|number| known(one, one.output(number)) == known(other, other.output(number)))
}

/// What an application knows of an input or output.
fn known<'a>(image: &Image<'a>, port: Option<Port<'a>>) -> Option<(&'a str, u32, i16, ElementType, Shape)> {
    let port = port?;
    let record = image.tensor(port.tensor)?;
    Some((port.name, port.scale.to_bits(), port.zero_point, record.element, record.shape))
}

/// Why an image is not one for this board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Refusal {
    /// It has more bytes than a slot.
    TooLarge {
        /// Bytes of the image.
        found: u32,
        /// Bytes of the slot.
        capacity: u32,
    },
    /// It was compiled for another target.
    ForeignTarget {
        /// The image's.
        found: TargetName,
        /// The board's.
        expected: TargetName,
    },
    /// It needs features that this runtime does not have: their bits.
    Features(u64),
    /// It uses a kernel that the backend does not have.
    KernelMissing(KernelId),
    /// It needs more arena than the board has in a memory region.
    Arena {
        /// The region, by position.
        region: u8,
        /// Bytes that it needs.
        needed: u32,
        /// Bytes that are there.
        found: u32,
    },
    /// The application does not know its inputs and outputs.
    Interface,
    /// It is older than the image that runs.
    Older {
        /// Its revision.
        found: u32,
        /// That of the image that runs.
        running: u32,
    },
    /// It is the image that runs.
    Running,
    /// What was received differs from what was announced.
    NotAnnounced,
    /// It is damaged, or no image of this format.
    Parse(ParseError),
    /// A section is damaged.
    Check(CheckError),
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooLarge { found, capacity } => write!(f, "{found} bytes, the slot has room for {capacity}"),
            Self::ForeignTarget { found, expected } => write!(f, "compiled for target {found}, this is {expected}"),
            Self::Features(bits) => write!(f, "needs features that this runtime does not have (bits {bits:#x})"),
            Self::KernelMissing(kernel) => write!(f, "uses kernel {kernel:?}, which this backend lacks"),
            Self::Arena { region, needed, found } => {
                write!(f, "memory region {region}: needs {needed} bytes of arena, there are {found}")
            }
            Self::Interface => f.write_str("has other inputs or outputs than the application needs"),
            Self::Older { found, running } => write!(f, "revision {found} is older than the running {running}"),
            Self::Running => f.write_str("this image runs already"),
            Self::NotAnnounced => f.write_str("other than announced"),
            Self::Parse(error) => write!(f, "{error}"),
            Self::Check(error) => write!(f, "{error}"),
        }
    }
}

impl core::error::Error for Refusal {}

#[cfg(test)]
mod tests {
    extern crate std;

    use super::*;
    use std::string::ToString;

    #[test]
    fn names_of_targets_are_shown_as_text() {
        assert_eq!(TargetName::from("cortex-m4").to_string(), "cortex-m4");
        assert_eq!(TargetName::from("").to_string(), "unknown");
        assert_eq!(TargetName([0xFF; TARGET_BYTES]).to_string(), "illegible");
        assert_eq!(TargetName::from("a-name-of-17-bytes").to_string(), "a-name-of-17-byt");
    }
}
