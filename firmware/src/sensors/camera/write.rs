//! Pixels into the network's input: written, stored until the other plane comes, or added up.

use super::format::Visitor;
use crate::tensor::index;

/// Pixels of the network's input, from one of the camera's on.
pub(super) struct Pixels<'a> {
    pub codes: &'a mut [i8],
    pub channels: usize,
    pub first_channel: usize,
    /// Number of the first pixel within the map.
    pub position: u32,
}

impl Pixels<'_> {
    /// Writes colors and returns their share of the frame's hash.
    pub fn write(&mut self, colors: impl Iterator<Item = [u8; 3]>) -> u32 {
        let mut hash = 0_u32;
        let first = self.first_channel;
        let mut pixels = self.codes.chunks_mut(self.channels.max(1)).zip(self.position..);
        // From inside the iterator, which is faster where pixels come in pairs.
        colors.for_each(|color| {
            let Some((codes, position)) = pixels.next() else { return };
            match codes.get_mut(first..) {
                Some([red, green, blue, ..]) => [*red, *green, *blue] = color.map(code),
                Some([grey, ..]) => [*grey, _, _] = color.map(code),
                _ => {}
            }
            hash = hash.wrapping_add(share(color, position));
        });
        hash
    }

    /// Replaces stored components by colors and returns the share of the hash.
    pub fn convert(&mut self, count: usize, color: impl Fn([u8; 3]) -> [u8; 3]) -> u32 {
        let mut hash = 0_u32;
        let pixels = self.codes.chunks_mut(self.channels.max(1)).take(count);
        for (codes, position) in pixels.zip(self.position..) {
            let Some([red, green, blue, ..]) = codes.get_mut(self.first_channel..) else { continue };
            let rgb = color([*red, *green, *blue].map(level));
            [*red, *green, *blue] = rgb.map(code);
            hash = hash.wrapping_add(share(rgb, position));
        }
        hash
    }
}

/// Writes the colors of pixels.
pub(super) struct Write<'a> {
    pub pixels: Pixels<'a>,
    pub hash: &'a mut u32,
}

impl Visitor for Write<'_> {
    fn visit(mut self, components: impl Iterator<Item = [u8; 3]>, color: impl Fn([u8; 3]) -> [u8; 3]) {
        *self.hash = self.hash.wrapping_add(self.pixels.write(components.map(color)));
    }
}

/// Stores the components of one plane, to be converted when the other has come.
pub(super) struct Store<'a> {
    pub pixels: Pixels<'a>,
    pub is_chroma: bool,
}

impl Visitor for Store<'_> {
    fn visit(self, components: impl Iterator<Item = [u8; 3]>, _: impl Fn([u8; 3]) -> [u8; 3]) {
        let mut pixels = self.pixels.codes.chunks_mut(self.pixels.channels.max(1));
        components.for_each(|components| {
            let codes = pixels.next().and_then(|codes| codes.get_mut(self.pixels.first_channel..));
            let Some([first, second, third, ..]) = codes else { return };
            let [y, u, v] = components.map(code);
            if self.is_chroma {
                [*second, *third] = [u, v];
            } else {
                *first = y;
            }
        });
    }
}

/// Adds components to the sums of the columns that they fall into.
pub(super) struct Add<'a> {
    /// Three per column.
    pub sums: &'a mut [u16],
    /// Column of the image where the components begin, counted from the crop's.
    pub column: u32,
    /// Binary logarithm of the columns that become one.
    pub bits: u32,
    /// How often each component counts.
    pub weight: u16,
}

impl Visitor for Add<'_> {
    fn visit(self, components: impl Iterator<Item = [u8; 3]>, _: impl Fn([u8; 3]) -> [u8; 3]) {
        let sums = self.sums.as_chunks_mut::<3>().0;
        let mut column = self.column;
        components.for_each(|components| {
            if let Some(sums) = sums.get_mut(index(column.wrapping_shr(self.bits))) {
                for (sum, component) in sums.iter_mut().zip(components) {
                    *sum = sum.wrapping_add(self.weight.wrapping_mul(component.into()));
                }
            }
            column = column.wrapping_add(1);
        });
    }
}

/// `u8 − 128`.
#[inline]
fn code(level: u8) -> i8 {
    (level ^ 0x80).cast_signed()
}

/// The level of a code.
#[inline]
fn level(code: i8) -> u8 {
    code.cast_unsigned() ^ 0x80
}

/// What a pixel adds to the hash of its frame: its color times an odd number drawn from its position, modulo 2^32. Sums
/// do not depend on the order of rows; a change of one pixel always changes them, other changes hide with a
/// probability of about 2^-32.
#[inline]
fn share([red, green, blue]: [u8; 3], position: u32) -> u32 {
    let drawn = position.wrapping_mul(0x9E37_79B1);
    u32::from_le_bytes([red, green, blue, 0]).wrapping_mul(drawn ^ (drawn >> 15) | 1)
}
