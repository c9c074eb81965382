//! An image that is part of the program.

use super::layout;

/// The bytes of an image, aligned as images have to be.
#[derive(Debug)]
#[repr(C, align(16))]
pub struct StoredImage<const BYTES: usize>([u8; BYTES]);

const _: () = assert!(align_of::<StoredImage<0>>() == layout::ALIGNMENT);

impl<const BYTES: usize> StoredImage<BYTES> {
    /// Takes the bytes of an image's file; [`super::Image::parse`] proves the rest.
    ///
    /// # Panics
    /// The bytes do not begin with an image's magic, or the header states another length. In a `static`, which
    /// [`crate::include_image`] makes, that is an error of the compiler:
    ///
    /// ```compile_fail
    /// use firmware::image::StoredImage;
    ///
    /// static CUT: StoredImage<16> = StoredImage::new(b"\x93DRIVE\r\n\x01\0\x01\0\x30\x02\0\0");
    /// ```
    #[allow(clippy::panic, reason = "in a static it is an error of the compiler")]
    pub const fn new(bytes: &[u8; BYTES]) -> Self {
        match layout::stated_length(bytes) {
            None => panic!("the file is no model image"),
            Some(length) => assert!(length == BYTES, "the model image is truncated, or something follows it"),
        }
        Self(*bytes)
    }

    /// What [`super::Image::parse`] takes.
    pub const fn bytes(&self) -> &[u8] {
        &self.0
    }
}

/// An image's file as `&'static [u8]`, aligned to 16: the image becomes a constant of the program. The path is that of
/// [`include_bytes`]: relative to the source file. A file that is no image, or a truncated one, does not compile.
///
/// ```
/// use firmware::image::Image;
///
/// static MODEL: &[u8] =
///     firmware::include_image!(concat!(env!("CARGO_MANIFEST_DIR"), "/src/image/example.bin"));
///
/// assert_eq!(Image::parse(MODEL)?.name(), "copy");
/// # Ok::<(), firmware::image::ParseError>(())
/// ```
///
/// ```compile_fail
/// static MODEL: &[u8] = firmware::include_image!(concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml"));
/// ```
#[macro_export]
macro_rules! include_image {
    ($path:expr) => {{
        static IMAGE: $crate::image::StoredImage<{ ::core::include_bytes!($path).len() }> =
            $crate::image::StoredImage::new(::core::include_bytes!($path));
        IMAGE.bytes()
    }};
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a failed test")]
mod tests {
    use super::*;
    use crate::image::Image;

    const EXAMPLE: &[u8; 544] = include_bytes!("example.bin");

    #[test]
    fn an_included_image_is_the_file_and_parses() {
        let image = crate::include_image!("example.bin");
        assert_eq!(image, EXAMPLE);
        assert_eq!(Image::parse(image).unwrap().name(), "copy");
    }

    #[test]
    #[should_panic(expected = "truncated")]
    fn a_truncated_image_is_refused() {
        let cut: &[u8; 528] = EXAMPLE.first_chunk().unwrap();
        StoredImage::new(cut);
    }

    #[test]
    #[should_panic(expected = "no model image")]
    fn another_file_is_refused() {
        let mut other = *EXAMPLE;
        other[0] ^= 1;
        StoredImage::new(&other);
    }
}
