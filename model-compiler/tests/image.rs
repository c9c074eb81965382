//! The sample image: accepted, checked, audited, run.

#[path = "support/sample_image.rs"]
mod sample_image;

use firmware::image::Image;
use model_compiler::emit::{AlignedBytes, emit};

#[test]
fn sample_is_accepted() {
    let bytes = AlignedBytes::from(emit(&sample_image::parts()).expect("emits").as_slice());
    let image = Image::parse(&bytes).expect("parses");
    println!("{} bytes, arena {}, work {}", bytes.len(), image.arena_bytes(), image.work());
    image.check().expect("checks");
    firmware::image::audit::audit(&image).expect("audits");
}
