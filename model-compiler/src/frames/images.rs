//! Image directories: what a classifier looks at.
//!
//! Every PNG or JPEG file of the folder is a frame, in the order of the file names; `labels.csv` may say what they show
//! ([`super::labels`]). An image has the network's size and is taken whole. Or all are scaled so that the shorter side
//! gets a given length, the longer one in proportion (rounded down), and cut to the network's size around the center:
//! the recipe of most networks that were trained on ImageNet (256, then 224). Scaling is bilinear, over the whole
//! area that a pixel stands for.
//!
//! A network of one channel reads grey levels: `(19595·R + 38470·G + 7471·B + 2^15) >> 16`, which leaves grey as it is.

use super::camera;
use super::{ByteMap, Frame, FrameFormat, labels};
use crate::error::{Error, ErrorCode, Result};
use firmware::tensor::Shape;
use image::RgbImage;
use image::imageops::{self, FilterType};
use rayon::prelude::*;
use std::path::Path;

const EXTENSIONS: [&str; 3] = ["png", "jpg", "jpeg"];

/// Loads every image of `folder`, with its label where there are labels.
///
/// # Errors
/// No image, one that is unreadable or of another size, or labels that do not fit.
pub(super) fn load(folder: &Path, format: &FrameFormat, classes: u16) -> Result<Vec<Frame>> {
    let shape = format.image.filter(|shape| matches!(shape.channels, 1 | 3)).ok_or_else(|| {
        let channels = format.image.map_or(0, |shape| shape.channels);
        let message = format!("the network reads {channels} channels, an image has 1 (grey) or 3 (RGB)");
        Error::new(ErrorCode::Frames, folder.display().to_string(), message)
            .with_help("feed it with a .safetensors file of raw inputs")
    })?;
    let files = image_files(folder)?;
    let labels = labels::read(folder, &files, classes)?;
    let maps: Vec<Result<ByteMap>> =
        files.par_iter().map(|file| load_image(&folder.join(file), shape, format.resize)).collect();
    let frame = |(i, (name, map)): (usize, (String, Result<ByteMap>))| {
        let label = labels.as_ref().map(|labels| labels[i].clone());
        Ok(Frame { name, rgb: Some(map?), label, ..Frame::default() })
    };
    files.into_iter().zip(maps).enumerate().map(frame).collect()
}

/// Names of the image files, sorted.
fn image_files(folder: &Path) -> Result<Vec<String>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| Error::io(folder, &e))? {
        let entry = entry.map_err(|e| Error::io(folder, &e))?;
        let path = entry.path();
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        let name = entry.file_name().to_string_lossy().into_owned();
        if EXTENSIONS.contains(&extension.as_str()) && !name.starts_with('.') && path.is_file() {
            files.push(name);
        }
    }
    if files.is_empty() {
        let error = Error::new(ErrorCode::Frames, folder.display().to_string(), "holds no image (PNG or JPEG)");
        return Err(error.with_help("a classifier's frames are image files side by side in one folder"));
    }
    files.sort();
    Ok(files)
}

fn load_image(path: &Path, shape: Shape, resize: Option<u16>) -> Result<ByteMap> {
    let image = camera::decode(path)?;
    let fitted = match resize {
        None => exact(image, shape),
        Some(shorter_side) => scaled_and_cropped(&image, shape, shorter_side),
    };
    let image = fitted.map_err(|e| e.within(path.display()))?;
    let data = if shape.channels == 1 { image.pixels().map(|pixel| grey(pixel.0)).collect() } else { image.into_raw() };
    Ok(ByteMap { shape, data })
}

fn exact(image: RgbImage, shape: Shape) -> Result<RgbImage> {
    let (width, height) = (u32::from(shape.width), u32::from(shape.height));
    if image.dimensions() == (width, height) {
        return Ok(image);
    }
    let message = format!("image is {}×{}, the network reads {width}×{height}", image.width(), image.height());
    Err(Error::new(ErrorCode::Frames, "", message).with_help(
        "--resize PIXELS scales every image to this shorter side and crops its center (ImageNet: 256 for 224×224)",
    ))
}

fn scaled_and_cropped(image: &RgbImage, shape: Shape, shorter_side: u16) -> Result<RgbImage> {
    let (network_width, network_height) = (u32::from(shape.width), u32::from(shape.height));
    let shorter = u64::from(shorter_side);
    let (width, height) = (u64::from(image.width()), u64::from(image.height()));
    let in_proportion = |side: u64| u32::try_from(side * shorter / width.min(height)).unwrap_or(u32::MAX);
    let (width, height) = (in_proportion(width), in_proportion(height));
    let (Some(spare_width), Some(spare_height)) =
        (width.checked_sub(network_width), height.checked_sub(network_height))
    else {
        let message = format!("scaled to {width}×{height}, the network reads {network_width}×{network_height}");
        let help = "give --resize at least the network's longer side";
        return Err(Error::new(ErrorCode::Frames, "", message).with_help(help));
    };
    let scaled = imageops::resize(image, width, height, FilterType::Triangle);
    let (left, top) = (spare_width / 2, spare_height / 2);
    Ok(imageops::crop_imm(&scaled, left, top, network_width, network_height).to_image())
}

/// Luma of ITU-R BT.601; the weights add up to 2^16.
fn grey([red, green, blue]: [u8; 3]) -> u8 {
    let [red, green, blue] = [red, green, blue].map(u32::from);
    ((19595 * red + 38470 * green + 7471 * blue + (1 << 15)) >> 16) as u8
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::InputKind;
    use std::fs;

    fn format(shape: Shape) -> FrameFormat {
        FrameFormat::new("classifier", [(InputKind::Image, shape)]).with_output("x", Some(Shape::vector(10)))
    }

    /// Pixels that hold their column, row and a constant.
    fn picture(width: u32, height: u32) -> RgbImage {
        RgbImage::from_fn(width, height, |x, y| image::Rgb([x as u8, y as u8, 9]))
    }

    fn folder(pictures: &[(&str, u32, u32)], labels: Option<&str>) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for (name, width, height) in pictures {
            picture(*width, *height).save(folder.path().join(name)).unwrap();
        }
        if let Some(labels) = labels {
            fs::write(folder.path().join(labels::FILE), labels).unwrap();
        }
        folder
    }

    fn load_from(folder: &tempfile::TempDir, shape: Shape, resize: Option<u16>) -> Result<Vec<Frame>> {
        super::super::load(folder.path(), &FrameFormat { resize, ..format(shape) })
    }

    const SMALL: Shape = Shape::map(2, 3, 3);

    #[test]
    fn images_are_frames_in_the_order_of_their_names() {
        let folder = folder(&[("b.png", 3, 2), ("a.PNG", 3, 2)], Some("b.png,7,horse\na.PNG,0\n"));
        fs::write(folder.path().join("notes.txt"), "no image").unwrap();
        let frames = load_from(&folder, SMALL, None).unwrap();
        let names: Vec<&str> = frames.iter().map(|frame| frame.name.as_str()).collect();
        assert_eq!(names, ["a.PNG", "b.png"]);
        let classes: Vec<u16> = frames.iter().map(|frame| frame.label.as_ref().unwrap().class).collect();
        assert_eq!(classes, [0, 7]);
        assert_eq!(frames[0].rgb.as_ref().unwrap().data, [0, 0, 9, 1, 0, 9, 2, 0, 9, 0, 1, 9, 1, 1, 9, 2, 1, 9]);
        fs::remove_file(folder.path().join(labels::FILE)).unwrap();
        assert!(load_from(&folder, SMALL, None).unwrap().iter().all(|frame| frame.label.is_none()));
    }

    #[test]
    fn jpeg_is_read_and_grey_stays_grey() {
        let folder = tempfile::tempdir().unwrap();
        let ramp = image::GrayImage::from_fn(3, 2, |x, y| image::Luma([(100 * x + 55 * y) as u8]));
        ramp.save(folder.path().join("a.png")).unwrap();
        image::GrayImage::from_pixel(3, 2, image::Luma([80])).save(folder.path().join("b.jpg")).unwrap();
        let frames = load_from(&folder, Shape::map(2, 3, 1), None).unwrap();
        assert_eq!(frames[0].rgb.as_ref().unwrap().data, [0, 100, 200, 55, 155, 255]);
        assert_eq!(frames[1].rgb.as_ref().unwrap().data, [80; 6]);
        assert_eq!([grey([255, 0, 0]), grey([0, 255, 0]), grey([0, 0, 255])], [76, 150, 29]);
    }

    #[test]
    fn resizing_scales_the_shorter_side_and_crops_the_center() {
        // 12×8 → 6×4, of which columns 1..=4 and all rows are left; each pixel stands for four.
        let folder = folder(&[("a.png", 12, 8)], None);
        let frames = load_from(&folder, Shape::map(4, 4, 3), Some(4)).unwrap();
        let data = &frames[0].rgb.as_ref().unwrap().data;
        let columns: Vec<u8> = data.iter().step_by(3).take(4).copied().collect();
        let rows: Vec<u8> = data.iter().skip(1).step_by(12).copied().collect();
        for (found, expected) in columns.iter().zip([2.5, 4.5, 6.5, 8.5]).chain(rows.iter().zip([0.5, 2.5, 4.5, 6.5])) {
            assert!((f64::from(*found) - expected).abs() <= 0.5, "{columns:?} {rows:?}");
        }
        // An image that has the network's size already is scaled like the others.
        let same = load_from(&folder, Shape::map(8, 12, 3), Some(16)).unwrap();
        assert_ne!(same[0].rgb.as_ref().unwrap().data, picture(12, 8).into_raw());
    }

    #[test]
    fn every_unusable_folder_is_refused_with_its_remedy() {
        type Case<'a> = (&'a [(&'a str, u32, u32)], Option<u16>, &'a str, &'a str);
        let cases: [Case<'_>; 3] = [
            (&[], None, "holds no image (PNG or JPEG)", "side by side in one folder"),
            (
                &[("a.png", 3, 2), ("b.png", 4, 2)],
                None,
                "b.png: image is 4×2, the network reads 3×2",
                "--resize PIXELS",
            ),
            (
                &[("a.png", 8, 8)],
                Some(2),
                "a.png: scaled to 2×2, the network reads 3×2",
                "at least the network's longer",
            ),
        ];
        for (pictures, resize, message, help) in cases {
            let error = load_from(&folder(pictures, None), SMALL, resize).unwrap_err();
            assert!(error.to_string().contains(message) && error.help.contains(help), "{error}");
        }
        let error = load_from(&folder(&[("a.png", 3, 2)], None), Shape::map(2, 3, 4), None).unwrap_err();
        assert!(error.message.contains("the network reads 4 channels"), "{error}");
    }

    #[test]
    fn a_corrupt_image_and_wrong_labels_are_named() {
        let good = [("a.png", 3, 2)];
        let damaged = folder(&good, None);
        let bytes = fs::read(damaged.path().join("a.png")).unwrap();
        fs::write(damaged.path().join("b.png"), &bytes[..bytes.len() / 2]).unwrap();
        let error = load_from(&damaged, SMALL, None).unwrap_err();
        assert!(error.location.ends_with("b.png") && error.message.starts_with("no readable image"), "{error}");
        let error = load_from(&folder(&good, Some("a.png,10")), SMALL, None).unwrap_err();
        assert!(error.location.ends_with("labels.csv: line 1"), "{error}");
    }

    #[test]
    fn only_images_are_scaled() {
        let folder = tempfile::tempdir().unwrap();
        let driving = FrameFormat::new("aim", [(InputKind::Image, SMALL), (InputKind::Goal, Shape::vector(2))]);
        let error = super::super::load(folder.path(), &FrameFormat { resize: Some(4), ..driving }).unwrap_err();
        assert_eq!((error.code, error.message.as_str()), (ErrorCode::Usage, "nothing here can be scaled"));
    }
}
