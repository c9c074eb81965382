//! Backends for x86-64. A token exists only where the processor and the operating system have its instructions.

#![allow(unsafe_code, reason = "instructions beyond the target's own; every block says why it is sound")]

use super::{Conv2dArgs, Kernels, LinearArgs, portable};
use crate::program::KernelId;
use crate::tensor::{Codes, CodesMut};

mod gemm;

cpufeatures::new!(avx2, "avx2");
cpufeatures::new!(avx512, "avx2", "avx512f", "avx512bw", "avx512dq", "avx512vl");

/// Leaf 7, ecx: AVX512_VNNI (Intel SDM volume 2, CPUID). The state of its registers is that of AVX-512 F.
const VNNI_BIT: u32 = 11;

/// 256-bit vectors, 16-bit multiply-add: AVX2.
#[derive(Clone, Copy, Debug)]
pub struct Avx2 {
    /// Nothing but [`Avx2::detect`] makes one.
    _proof: (),
}

/// 512-bit vectors with 8-bit dot products: AVX-512 F, BW, DQ, VL and VNNI.
#[derive(Clone, Copy, Debug)]
pub struct Avx512Vnni {
    /// Nothing but [`Avx512Vnni::detect`] makes one.
    _proof: (),
}

impl Avx2 {
    /// The token, where this machine has the instructions.
    pub fn detect() -> Option<Self> {
        avx2::get().then_some(Self { _proof: () })
    }
}

impl Avx512Vnni {
    /// The token, where this machine has the instructions.
    pub fn detect() -> Option<Self> {
        let vnni = || core::arch::x86_64::__cpuid_count(7, 0).ecx >> VNNI_BIT & 1 == 1;
        (avx512::get() && vnni()).then_some(Self { _proof: () })
    }
}

impl Avx512Vnni {
    /// AVX-512 includes AVX2.
    fn avx2(self) -> Avx2 {
        Avx2 { _proof: () }
    }
}

impl Kernels for Avx2 {
    fn supported(&self) -> &'static [KernelId] {
        KernelId::ALL
    }

    fn conv2d(&self, args: &Conv2dArgs<'_>, input: &[i8], output: CodesMut<'_>, scratch: &mut [u8]) {
        match args.kernel {
            KernelId::Direct => portable::conv2d::conv2d(args, input, output, scratch),
            KernelId::K4N16 => gemm::conv2d(*self, args, input, output, scratch).unwrap_or_default(),
        }
    }

    fn linear(&self, args: &LinearArgs<'_>, input: Codes<'_>, output: CodesMut<'_>, scratch: &mut [u8]) {
        match (args.kernel, input) {
            (KernelId::K4N16, Codes::I8(input)) if !args.wide => gemm::linear(*self, args, input, output, scratch),
            (KernelId::K4N16, Codes::I16(input)) if !args.wide => gemm::linear_i16(*self, args, input, output, scratch),
            _ => Some(portable::linear::linear(args, input, output, scratch)),
        }
        .unwrap_or_default()
    }
}

impl Kernels for Avx512Vnni {
    fn supported(&self) -> &'static [KernelId] {
        KernelId::ALL
    }

    fn conv2d(&self, args: &Conv2dArgs<'_>, input: &[i8], output: CodesMut<'_>, scratch: &mut [u8]) {
        match args.kernel {
            KernelId::Direct => portable::conv2d::conv2d(args, input, output, scratch),
            KernelId::K4N16 => gemm::conv2d(*self, args, input, output, scratch).unwrap_or_default(),
        }
    }

    fn linear(&self, args: &LinearArgs<'_>, input: Codes<'_>, output: CodesMut<'_>, scratch: &mut [u8]) {
        match (args.kernel, input) {
            (KernelId::K4N16, Codes::I8(input)) if !args.wide => {
                gemm::linear(*self, args, input, output, scratch).unwrap_or_default();
            }
            _ => self.avx2().linear(args, input, output, scratch),
        }
    }
}
