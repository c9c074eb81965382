//! Pixel formats: bytes of a row to color components, components to RGB.

use serde::{Deserialize, Serialize};

/// How the pixels of a camera lie in memory.
///
/// Chroma samples belong to the pixels whose bytes they lie among: to two neighbors in YUYV (4:2:2), to two by two in
/// NV12 (4:2:0). They are repeated, not interpolated, wherever the camera sited them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum PixelFormat {
    /// Red, green, blue.
    Rgb,
    /// Blue, green, red.
    Bgr,
    /// Red, green, blue, and a byte that is not read.
    Rgba,
    /// Blue, green, red, and a byte that is not read.
    Bgra,
    /// One grey level.
    Grey,
    /// Y, U, Y, V for two pixels.
    Yuyv(YuvRange),
    /// A plane of Y; below it, as rows of their own, U and V in turn for two by two pixels.
    Nv12(YuvRange),
}

/// Codes of black and white in Y, and how far U and V reach around 128.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum YuvRange {
    /// Y 0..=255, U and V 128 ± 127.5 (JFIF).
    Full,
    /// Y 16..=235, U and V 128 ± 112 (ITU-R BT.601).
    Limited,
}

/// Factors of the conversion to RGB, Q16.
struct Matrix {
    black: i32,
    luma: i32,
    red_v: i32,
    green_u: i32,
    green_v: i32,
    blue_u: i32,
}

const FULL: Matrix = Matrix { black: 0, luma: 65536, red_v: 91881, green_u: -22553, green_v: -46802, blue_u: 116_130 };
const LIMITED: Matrix =
    Matrix { black: 16, luma: 76309, red_v: 104_597, green_u: -25675, green_v: -53279, blue_u: 132_201 };

impl YuvRange {
    /// RGB of Y, U, V by ITU-R BT.601 (`K_R = 0.299`, `K_B = 0.114`), with `y = luma·(Y − black)`, `u = U − 128`,
    /// `v = V − 128` and factors rounded to Q16: `R = R(y + red_v·v, 16)`, `G = R(y + green_u·u + green_v·v, 16)`,
    /// `B = R(y + blue_u·u, 16)`, each clamped to 0..=255. `R(·, 16)` rounds ties up.
    #[inline]
    pub fn to_rgb(self, [y, u, v]: [u8; 3]) -> [u8; 3] {
        let matrix = match self {
            Self::Full => &FULL,
            Self::Limited => &LIMITED,
        };
        // Factors below 2^18 times codes below 2^8: every sum lies within 28 bits.
        let luma = i32::from(y).wrapping_sub(matrix.black).wrapping_mul(matrix.luma).wrapping_add(1 << 15);
        let [u, v] = [u, v].map(|chroma| i32::from(chroma).wrapping_sub(128));
        let red = luma.wrapping_add(matrix.red_v.wrapping_mul(v));
        let green = luma.wrapping_add(matrix.green_u.wrapping_mul(u)).wrapping_add(matrix.green_v.wrapping_mul(v));
        let blue = luma.wrapping_add(matrix.blue_u.wrapping_mul(u));
        [red, green, blue].map(|sum| u8::try_from((sum >> 16).clamp(0, 255)).unwrap_or(u8::MAX))
    }
}

/// Bytes that cannot be taken apart, and the pixels that they are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Unit {
    pub bytes: u8,
    pub pixels: u8,
}

impl PixelFormat {
    /// Whether pixels share chroma samples, so that width (and of NV12 height) must be even.
    pub(super) const fn is_subsampled(self) -> bool {
        matches!(self, Self::Yuyv(_) | Self::Nv12(_))
    }

    /// The smallest piece of a row; of NV12 a row of Y or, where `chroma`, of U and V.
    pub(super) const fn unit(self, chroma: bool) -> Unit {
        match self {
            Self::Rgb | Self::Bgr => Unit { bytes: 3, pixels: 1 },
            Self::Rgba | Self::Bgra => Unit { bytes: 4, pixels: 1 },
            Self::Grey => Unit { bytes: 1, pixels: 1 },
            Self::Yuyv(_) => Unit { bytes: 4, pixels: 2 },
            Self::Nv12(_) if chroma => Unit { bytes: 2, pixels: 2 },
            Self::Nv12(_) => Unit { bytes: 1, pixels: 1 },
        }
    }

    /// RGB of a pixel's components.
    #[inline]
    pub(super) fn color(self, components: [u8; 3]) -> [u8; 3] {
        match self {
            Self::Yuyv(range) | Self::Nv12(range) => range.to_rgb(components),
            _ => components,
        }
    }
}

/// Which pixels of a piece are meant.
#[derive(Clone, Copy, Debug)]
pub(super) struct Span {
    pub skip: usize,
    pub count: usize,
}

/// What is done with the pixels of a piece. A trait instead of a closure, so that each format has a loop of its own.
pub(super) trait Visitor {
    /// `components` as they lie in the image (Y of an NV12 row comes as `[Y, 0, 0]`, U and V as `[0, U, V]`); `color`
    /// makes RGB of them.
    fn visit(self, components: impl Iterator<Item = [u8; 3]>, color: impl Fn([u8; 3]) -> [u8; 3]);
}

/// Shows a visitor the pixels `span` of `bytes`, which begin with a whole unit.
pub(super) fn visit(format: PixelFormat, chroma: bool, bytes: &[u8], span: Span, visitor: impl Visitor) {
    let Span { skip, count } = span;
    let same = |rgb| rgb;
    match format {
        PixelFormat::Rgb => visitor.visit(taken::<3>(bytes, span).copied(), same),
        PixelFormat::Bgr => visitor.visit(taken::<3>(bytes, span).map(|&[b, g, r]| [r, g, b]), same),
        PixelFormat::Rgba => visitor.visit(taken::<4>(bytes, span).map(|&[r, g, b, _]| [r, g, b]), same),
        PixelFormat::Bgra => visitor.visit(taken::<4>(bytes, span).map(|&[b, g, r, _]| [r, g, b]), same),
        PixelFormat::Grey => visitor.visit(taken::<1>(bytes, span).map(|&[grey]| [grey; 3]), same),
        PixelFormat::Yuyv(range) => {
            let pairs = bytes.as_chunks::<4>().0.iter().skip(skip / 2);
            let pixels = pairs.flat_map(|&[y0, u, y1, v]| [[y0, u, v], [y1, u, v]]);
            visitor.visit(pixels.skip(skip % 2).take(count), |yuv| range.to_rgb(yuv));
        }
        PixelFormat::Nv12(range) if chroma => {
            let pairs = bytes.as_chunks::<2>().0.iter().skip(skip / 2);
            let pixels = pairs.flat_map(|&[u, v]| [[0, u, v]; 2]);
            visitor.visit(pixels.skip(skip % 2).take(count), |yuv| range.to_rgb(yuv));
        }
        PixelFormat::Nv12(range) => {
            visitor.visit(taken::<1>(bytes, span).map(|&[y]| [y, 0, 0]), |yuv| range.to_rgb(yuv));
        }
    }
}

/// Pixels of `N` bytes.
fn taken<const N: usize>(bytes: &[u8], Span { skip, count }: Span) -> impl Iterator<Item = &[u8; N]> {
    let chunks: &[[u8; N]] = bytes.as_chunks::<N>().0;
    chunks.get(skip..).unwrap_or_default().iter().take(count)
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use std::vec::Vec;

    const K_R: f64 = 0.299;
    const K_B: f64 = 0.114;

    /// Factors in real numbers: luma, red·v, green·u, green·v, blue·u.
    fn factors(range: YuvRange) -> [f64; 5] {
        let (luma, chroma) = match range {
            YuvRange::Full => (1.0, 1.0),
            YuvRange::Limited => (255.0 / 219.0, 255.0 / 224.0),
        };
        let [red, blue] = [2.0 * (1.0 - K_R), 2.0 * (1.0 - K_B)];
        let green = 1.0 - K_R - K_B;
        [luma, red * chroma, -blue * K_B / green * chroma, -red * K_R / green * chroma, blue * chroma]
    }

    #[test]
    fn factors_follow_from_the_standard() {
        for (range, matrix) in [(YuvRange::Full, FULL), (YuvRange::Limited, LIMITED)] {
            let rounded = factors(range).map(|factor| (factor * 65536.0).round() as i32);
            assert_eq!(rounded, [matrix.luma, matrix.red_v, matrix.green_u, matrix.green_v, matrix.blue_u]);
        }
    }

    #[test]
    fn every_yuv_color_is_within_half_a_level_of_the_standard() {
        for range in [YuvRange::Full, YuvRange::Limited] {
            let [luma, red_v, green_u, green_v, blue_u] = factors(range);
            let black = if range == YuvRange::Full { 0.0 } else { 16.0 };
            for yuv in (0..1 << 24).step_by(3).map(|i: u32| [i, i >> 8, i >> 16].map(|v| v as u8)) {
                let [y, u, v] = yuv.map(f64::from);
                let (y, u, v) = (luma * (y - black), u - 128.0, v - 128.0);
                let real = [y + red_v * v, y + green_u * u + green_v * v, y + blue_u * u];
                for (found, real) in range.to_rgb(yuv).into_iter().zip(real) {
                    let error = (f64::from(found) - real.clamp(0.0, 255.0)).abs();
                    assert!(error < 0.505, "{range:?} {yuv:?}: {found} against {real}");
                }
            }
        }
    }

    #[test]
    fn greys_and_corners_of_the_ranges() {
        for grey in 0..=255 {
            assert_eq!(YuvRange::Full.to_rgb([grey, 128, 128]), [grey; 3]);
        }
        for (yuv, rgb) in [
            ([16, 128, 128], [0; 3]),
            ([235, 128, 128], [255; 3]),
            ([0, 128, 128], [0; 3]),
            ([255, 128, 128], [255; 3]),
            ([81, 90, 240], [254, 0, 0]),
            ([145, 54, 34], [0, 255, 1]),
            ([41, 240, 110], [0, 0, 255]),
        ] {
            assert_eq!(YuvRange::Limited.to_rgb(yuv), rgb, "{yuv:?}");
        }
    }

    struct Collect<'a>(&'a mut Vec<[u8; 3]>);

    impl Visitor for Collect<'_> {
        fn visit(self, components: impl Iterator<Item = [u8; 3]>, _: impl Fn([u8; 3]) -> [u8; 3]) {
            self.0.extend(components);
        }
    }

    #[test]
    fn components_come_in_the_order_of_each_format() {
        let bytes: Vec<u8> = (0..24).collect();
        let range = YuvRange::Full;
        for (format, chroma, expected) in [
            (PixelFormat::Rgb, false, [[3, 4, 5], [6, 7, 8], [9, 10, 11]]),
            (PixelFormat::Bgr, false, [[5, 4, 3], [8, 7, 6], [11, 10, 9]]),
            (PixelFormat::Rgba, false, [[4, 5, 6], [8, 9, 10], [12, 13, 14]]),
            (PixelFormat::Bgra, false, [[6, 5, 4], [10, 9, 8], [14, 13, 12]]),
            (PixelFormat::Grey, false, [[1; 3], [2; 3], [3; 3]]),
            (PixelFormat::Yuyv(range), false, [[2, 1, 3], [4, 5, 7], [6, 5, 7]]),
            (PixelFormat::Nv12(range), false, [[1, 0, 0], [2, 0, 0], [3, 0, 0]]),
            (PixelFormat::Nv12(range), true, [[0, 0, 1], [0, 2, 3], [0, 2, 3]]),
        ] {
            let mut found = Vec::new();
            visit(format, chroma, &bytes, Span { skip: 1, count: 3 }, Collect(&mut found));
            assert_eq!(found, expected, "{format:?}");
            let mut none = Vec::new();
            visit(format, chroma, &bytes, Span { skip: 99, count: 3 }, Collect(&mut none));
            assert_eq!(none, [[0; 3]; 0]);
        }
    }
}
