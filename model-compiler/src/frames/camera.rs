//! Camera image to network input: the centered crop, never scaled.

use super::ByteMap;
use crate::error::{Error, ErrorCode, Result};
use firmware::tensor::Shape;
use image::RgbImage;
use std::path::Path;

/// Reads an image file and cuts out its center at the network's size. An image of exactly that size is taken whole.
///
/// # Errors
/// The file is missing or no readable image, or the image is smaller than the network's input.
pub fn load(path: &Path, shape: Shape) -> Result<ByteMap> {
    let image = decode(path)?;
    let (width, height) = image.dimensions();
    let full = FullImage { height: height as usize, width: width as usize, rgb: image.as_raw() };
    center_crop(&full, shape).map_err(|e| e.within(path.display()))
}

/// The pixels of an image file, told from its first bytes.
///
/// # Errors
/// The file is missing or no readable image.
pub fn decode(path: &Path) -> Result<RgbImage> {
    let reader = image::ImageReader::open(path).and_then(image::ImageReader::with_guessed_format);
    let decoded = reader.map_err(|e| Error::io(path, &e))?.decode();
    let refuse = |e: image::ImageError| {
        Error::new(ErrorCode::Frames, path.display().to_string(), format!("no readable image: {e}"))
            .with_help("expected a whole PNG or JPEG file; copy or save it again")
    };
    Ok(decoded.map_err(refuse)?.into_rgb8())
}

struct FullImage<'a> {
    height: usize,
    width: usize,
    /// `height·width·3`.
    rgb: &'a [u8],
}

/// Rows `(H − h)/2 ..` and columns `(W − w)/2 ..`: for 400×300 and 256×256 rows 22..=277 and columns 72..=327.
fn center_crop(full: &FullImage<'_>, shape: Shape) -> Result<ByteMap> {
    let (height, width) = (usize::from(shape.height), usize::from(shape.width));
    let (Some(spare_rows), Some(spare_columns)) = (full.height.checked_sub(height), full.width.checked_sub(width))
    else {
        let message = format!("image is {}×{}, the network needs at least {width}×{height}", full.width, full.height);
        return Err(Error::new(ErrorCode::Frames, "", message).with_help("images are cropped, never enlarged"));
    };
    let rows = full.rgb.chunks(full.width * 3).skip(spare_rows / 2).take(height);
    let left = spare_columns / 2 * 3;
    Ok(ByteMap { shape, data: rows.flat_map(|row| &row[left..left + width * 3]).copied().collect() })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Pixels that hold their own row and column (modulo 256).
    fn crop(width: usize, height: usize, side: u16) -> Result<ByteMap> {
        let pixel = |i: usize| [(i / width) as u8, (i % width) as u8, (i % width / 256) as u8];
        let rgb: Vec<u8> = (0..width * height).flat_map(pixel).collect();
        center_crop(&FullImage { height, width, rgb: &rgb }, Shape::map(side, side, 3))
    }

    #[test]
    fn the_crop_of_the_trained_camera_starts_at_row_22_and_column_72() {
        let map = crop(400, 300, 256).unwrap();
        assert_eq!(map.data.len(), 256 * 256 * 3);
        assert_eq!(map.data[..3], [22, 72, 0]);
        assert_eq!(map.data[map.data.len() - 3..], [(277 % 256) as u8, (327 % 256) as u8, 1]);
    }

    #[test]
    fn odd_remainders_round_down_and_the_exact_size_is_whole() {
        assert_eq!(crop(1242, 375, 256).unwrap().data[..3], [59, (493 % 256) as u8, 1]);
        assert_eq!(crop(256, 256, 256).unwrap().data[..3], [0, 0, 0]);
    }

    #[test]
    fn a_small_image_is_refused() {
        let message = crop(400, 200, 256).unwrap_err().to_string();
        assert!(message.contains("image is 400×200, the network needs at least 256×256"), "{message}");
    }
}
