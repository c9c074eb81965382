//! What the proofs share: a panic handler that calls a symbol that nothing defines, so that one reachable panic is a link
//! error, and an inference of which nothing is known.
#![no_std]

use core::hint::black_box;
use core::panic::PanicInfo;
use firmware::engine::{Engine, Progress};
use firmware::image::Image;
use firmware::kernels::Portable;

unsafe extern "C" {
    safe fn a_panic_is_reachable() -> !;
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    a_panic_is_reachable()
}

/// Everything from an image to waypoints.
pub fn infer(image: &[u8], arena: [&mut [u8]; 2], inputs: &[&[u8]]) -> Option<()> {
    let image = Image::parse(image).ok()?;
    image.check().ok()?;
    let mut engine = Engine::new(image, Portable, arena).ok()?;
    engine.self_test().ok()?;
    engine.start(inputs).ok()?;
    while engine.step().ok()? != Progress::Done {}
    black_box(engine.waypoints(0).ok()?);
    let output = black_box(engine.output(0).ok()?);
    if cfg!(feature = "twin-index") {
        black_box(output[output.len() / 2]);
    }
    Some(())
}
