//! Rust source that includes the image.

use crate::emit::AlignedBytes;
use crate::error::{Error, ErrorCode, Result};
use firmware::image::Image;
use std::path::Path;

pub(super) fn file(image: &[u8], image_file: &Path) -> Result<String> {
    let path = image_file.to_str().ok_or_else(|| {
        Error::new(ErrorCode::Usage, image_file.display().to_string(), "the file's name is not UTF-8")
            .with_help("choose another name")
    })?;
    let aligned = AlignedBytes::from(image);
    let parsed = Image::parse(&aligned)?;
    let (name, steps, arena) = (parsed.name(), parsed.step_count(), parsed.arena_bytes());
    Ok(format!(
        "// Written by model-compiler.\n\n\
         /// Model image {name:?}: {} B, {steps} steps, arena of {arena} B aligned to {}.\n\
         pub static MODEL: &[u8] = firmware::include_image!({path:?});\n",
        image.len(),
        parsed.arena_alignment()
    ))
}
