//! The twin of `inference`: with one float operation, which must be found.
#![no_std]
#![no_main]

use core::hint::black_box;
use proof::infer;

/// What a boot loader would call.
#[unsafe(no_mangle)]
pub extern "C" fn start() -> bool {
    black_box(black_box(1.5_f32) * black_box(2.5));
    infer(black_box(&[]), [black_box(&mut [0; 64]), black_box(&mut [0; 64])], black_box(&[])).is_some()
}
