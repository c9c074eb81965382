//! Memory regions: a machine has several memories, and the arena has a part in each that the compiler planned for.

use super::layout::region;
use core::fmt;

/// A region as the header lists it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Region {
    /// Name (`fast`, `main`, `slow`), distinct within an image.
    pub name: RegionName,
    /// Bytes that the caller provides there; 0 where the plan puts nothing into this region.
    pub bytes: u32,
    /// Alignment of those bytes: a power of two, 16..=4096.
    pub alignment: u32,
}

/// Name of a region: one to eight visible ASCII characters.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct RegionName([u8; region::NAME_BYTES]);

impl RegionName {
    /// The ordinary region.
    pub const MAIN: Self = Self(*b"main\0\0\0\0");

    /// A name; `None` where it is empty, too long, or holds something else than visible ASCII.
    pub fn new(name: &str) -> Option<Self> {
        let mut field = [0; region::NAME_BYTES];
        field.get_mut(..name.len())?.copy_from_slice(name.as_bytes());
        Self::from_bytes(field).filter(|found| found.as_str() == name)
    }

    /// Reads the stored form: the characters, then only zeros.
    pub fn from_bytes(field: [u8; region::NAME_BYTES]) -> Option<Self> {
        let name = super::text(&field)?;
        (!name.is_empty() && name.bytes().all(|byte| byte.is_ascii_graphic())).then_some(Self(field))
    }

    /// The stored form.
    pub const fn to_bytes(self) -> [u8; region::NAME_BYTES] {
        self.0
    }

    /// The characters.
    pub fn as_str(&self) -> &str {
        super::text(&self.0).unwrap_or_default()
    }
}

impl fmt::Display for RegionName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

impl fmt::Debug for RegionName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self.as_str(), f)
    }
}

#[cfg(feature = "defmt")]
impl defmt::Format for RegionName {
    fn format(&self, f: defmt::Formatter<'_>) {
        defmt::write!(f, "{=str}", self.as_str());
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed expectation is a failed test")]
mod tests {
    extern crate std;
    use super::*;
    use std::string::ToString;

    #[test]
    fn names_are_one_to_eight_visible_characters() {
        assert_eq!(RegionName::new("main"), Some(RegionName::MAIN));
        assert_eq!(RegionName::new("12345678").unwrap().to_string(), "12345678");
        for bad in ["", "123456789", "a b", "tab\t", "ümlaut", "nul\0"] {
            assert_eq!(RegionName::new(bad), None, "{bad:?}");
        }
        assert_eq!(RegionName::from_bytes(*b"a\0b\0\0\0\0\0"), None, "something behind the end");
    }
}
