//! What the tests of the x86-64 kernels share: every backend that this machine has, and the calls that are timed.

extern crate std;

use super::{Avx2, Avx512Vnni};
use crate::kernels::Kernels;

/// Runs `test` with each backend that this machine has, and says which it has not.
pub(super) fn for_backends(test: impl Fn(&dyn Kernels)) {
    match Avx2::detect() {
        Some(kernels) => test(&kernels),
        None => std::println!("not run: this machine has no AVX2"),
    }
    match Avx512Vnni::detect() {
        Some(kernels) => test(&kernels),
        None => std::println!("not run: this machine has no AVX-512 with VNNI"),
    }
}
