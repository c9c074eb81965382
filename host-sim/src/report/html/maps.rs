//! Camera images and LiDAR histograms as pictures inside the page.

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use image::imageops::{self, FilterType};
use image::{ExtendedColorType, ImageEncoder, RgbImage, codecs::png::PngEncoder};
use model_compiler::frames::{ByteMap, bev};

/// The histogram from above: rows become columns, right is right, far is up; denser cells are darker.
pub(super) fn lidar_uri(map: &ByteMap) -> String {
    let (rows, columns) = (usize::from(map.shape.height), usize::from(map.shape.width));
    let channels = usize::from(map.shape.channels);
    let mut pixels = Vec::with_capacity(2 * rows * columns);
    for column in 0..columns {
        for row in (0..rows).rev() {
            let cell = &map.data[(row * columns + column) * channels..][..channels];
            let count: u32 = cell.iter().map(|&count| u32::from(count)).sum();
            let full = u32::from(bev::MAX_COUNT) * channels as u32;
            let shade = if count == 0 { 0 } else { 80 + 175 * count.min(full) / full };
            pixels.extend([0, shade as u8]);
        }
    }
    png_uri(&pixels, rows, columns, ExtendedColorType::La8)
}

/// The camera image as it is.
pub(super) fn camera_uri(map: &ByteMap) -> String {
    png_uri(&map.data, map.shape.width.into(), map.shape.height.into(), ExtendedColorType::Rgb8)
}

/// The camera image, made smaller until it is no higher than so many pixels.
pub(super) fn small_camera_uri(map: &ByteMap, height: u32) -> String {
    let (full_width, full_height) = (u32::from(map.shape.width), u32::from(map.shape.height));
    if full_height <= height {
        return camera_uri(map);
    }
    let image = RgbImage::from_raw(full_width, full_height, map.data.clone());
    let image = image.expect("a map has its shape's number of bytes");
    let width = (full_width * height / full_height).max(1);
    let small = imageops::resize(&image, width, height, FilterType::Triangle);
    png_uri(small.as_raw(), width as usize, height as usize, ExtendedColorType::Rgb8)
}

/// A PNG file inside its address.
pub(super) fn png_uri(pixels: &[u8], width: usize, height: usize, color: ExtendedColorType) -> String {
    let mut bytes = Vec::new();
    let encoder = PngEncoder::new(&mut bytes);
    encoder.write_image(pixels, width as u32, height as u32, color).expect("a map has its shape's number of bytes");
    format!("data:image/png;base64,{}", BASE64_STANDARD.encode(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use firmware::tensor::Shape;

    fn decoded(uri: &str) -> image::DynamicImage {
        let bytes = BASE64_STANDARD.decode(uri.strip_prefix("data:image/png;base64,").unwrap()).unwrap();
        image::load_from_memory(&bytes).unwrap()
    }

    #[test]
    fn the_histogram_is_turned_so_that_right_is_right_and_far_is_up() {
        // Row 0 is rightmost, column 0 farthest: one count there is the upper right corner.
        let mut map = ByteMap { shape: Shape::map(2, 2, 2), data: vec![0; 8] };
        map.data[0] = 5;
        let image = decoded(&lidar_uri(&map)).into_luma_alpha8();
        let alpha = |x, y| image.get_pixel(x, y).0[1];
        assert!(alpha(1, 0) > 100 && alpha(0, 0) == 0 && alpha(0, 1) == 0 && alpha(1, 1) == 0);
    }

    #[test]
    fn a_large_camera_image_is_made_smaller_in_proportion() {
        let map = ByteMap { shape: Shape::map(40, 100, 3), data: (0..12000).map(|i| (i % 3 * 100) as u8).collect() };
        let small = decoded(&small_camera_uri(&map, 10)).into_rgb8();
        assert_eq!(small.dimensions(), (25, 10));
        assert_eq!(small.get_pixel(7, 3).0, [0, 100, 200]);
        assert_eq!(small_camera_uri(&map, 40), camera_uri(&map));
    }
}
