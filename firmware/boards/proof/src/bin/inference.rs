//! Inference alone, for a machine without floating point: there every float operation is a call of the compiler's
//! library, so that a program without such a call has none. The program is not meant to run.
#![no_std]
#![no_main]

use core::hint::black_box;
use proof::infer;

/// What a boot loader would call.
#[unsafe(no_mangle)]
pub extern "C" fn start() -> bool {
    infer(black_box(&[]), [black_box(&mut [0; 64]), black_box(&mut [0; 64])], black_box(&[])).is_some()
}
