//! Links only if no panic is reachable: the panic handler calls a symbol that nothing defines, so that one reachable
//! panic is a link error. What is linked is what drives: parse, check, inference, self-test, the waypoints.
//!
//! The program is not meant to run. Each `twin-*` feature adds one panic of a usual kind and must not link.
#![no_std]
#![no_main]

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

/// What a boot loader would call. Nothing is known of the image, the arena and the inputs.
#[unsafe(no_mangle)]
pub extern "C" fn start() -> bool {
    let mut arena = [0; 64];
    infer(black_box(&[]), black_box(&mut arena), black_box(&[])).is_some() && twin(black_box(&[]))
}

fn infer(image: &[u8], arena: &mut [u8], inputs: &[&[u8]]) -> Option<()> {
    let image = Image::parse(image).ok()?;
    image.check().ok()?;
    let mut engine = Engine::new(image, Portable, arena).ok()?;
    engine.self_test().ok()?;
    engine.start(inputs).ok()?;
    while engine.step().ok()? != Progress::Done {}
    black_box(engine.output(0).ok()?);
    black_box(engine.waypoints(0).ok()?);
    Some(())
}

/// One panic of a kind, where a feature asks for it.
fn twin(bytes: &[u8]) -> bool {
    if cfg!(feature = "twin-index") {
        return bytes[bytes.len() / 2] == 0;
    }
    if cfg!(feature = "twin-unwrap") {
        return bytes.first().copied().unwrap() == 0;
    }
    if cfg!(feature = "twin-division") {
        return 100 / bytes.len() == 0;
    }
    true
}
