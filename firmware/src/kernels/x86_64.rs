//! Backends for x86-64. A token exists only where the processor and the operating system have its instructions.

#![allow(unsafe_code, reason = "instructions beyond the target's own; every block says why it is sound")]

use super::{
    AttentionArgs, Conv2dArgs, Kernels, LayerNormArgs, LinearArgs, PoolArgs, RequantArgs, ResizeArgs, SumArgs,
    TermArgs, TokensArgs, portable,
};
use crate::program::KernelId;
use crate::tensor::{Codes, CodesMut};

mod attention;
mod elementwise;
mod gemm;
mod layer_norm;
mod pairs;
mod pool;
mod resize_bilinear;
mod sums;
#[cfg(test)]
mod testing;
mod tokens;

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
            (KernelId::K4N16, Codes::I8(input)) if !args.wide => {
                gemm::linear(*self, args, input, output, scratch).unwrap_or_default();
            }
            (KernelId::K4N16, Codes::I16(input)) if !args.wide => {
                gemm::linear_i16(*self, args, input, output, scratch).unwrap_or_default();
            }
            _ => portable::linear::linear(args, input, output, scratch),
        }
    }

    fn max_pool(&self, args: &PoolArgs, input: Option<Codes<'_>>, output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has AVX2.
        unsafe { pool::max_pool_avx2(args, input, output) }
    }

    fn average_pool(&self, args: &PoolArgs, requant: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has AVX2.
        unsafe { pool::average_pool_avx2(args, requant, input, output) }
    }

    fn global_pool(&self, channels: u16, sum: &SumArgs, terms: &[TermArgs<'_>], output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has AVX2.
        unsafe { pool::global_pool_avx2(channels, sum, terms, output) }
    }

    fn add(&self, sum: &SumArgs, terms: &[TermArgs<'_>; 2], output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has AVX2.
        unsafe { elementwise::add_avx2(sum, terms, output) }
    }

    fn requantize(&self, args: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has AVX2.
        unsafe { elementwise::requantize_avx2(args, input, output) }
    }

    fn resize_bilinear(&self, args: &ResizeArgs<'_>, output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has AVX2.
        unsafe { resize_bilinear::avx2(args, output) }
    }

    fn tokens(&self, args: &TokensArgs<'_>, output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has AVX2.
        unsafe { tokens::avx2(args, output) }
    }

    fn layer_norm(&self, args: &LayerNormArgs<'_>, input: Codes<'_>, output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has AVX2.
        unsafe { layer_norm::avx2(args, input, output) }
    }

    fn attention(
        &self,
        args: &AttentionArgs<'_>,
        query: Option<&[i8]>,
        key: &[i8],
        value: &[i8],
        output: CodesMut<'_>,
        scratch: &mut [u8],
    ) {
        // SAFETY: the token proves that this machine has AVX2.
        unsafe { attention::avx2(*self, args, query, key, value, output, scratch) }
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

    fn max_pool(&self, args: &PoolArgs, input: Option<Codes<'_>>, output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has the AVX-512 extensions named there.
        unsafe { pool::max_pool_avx512(args, input, output) }
    }

    fn average_pool(&self, args: &PoolArgs, requant: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has the AVX-512 extensions named there.
        unsafe { pool::average_pool_avx512(args, requant, input, output) }
    }

    fn global_pool(&self, channels: u16, sum: &SumArgs, terms: &[TermArgs<'_>], output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has the AVX-512 extensions named there.
        unsafe { pool::global_pool_avx512(channels, sum, terms, output) }
    }

    fn add(&self, sum: &SumArgs, terms: &[TermArgs<'_>; 2], output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has the AVX-512 extensions named there.
        unsafe { elementwise::add_avx512(sum, terms, output) }
    }

    fn requantize(&self, args: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has the AVX-512 extensions named there.
        unsafe { elementwise::requantize_avx512(args, input, output) }
    }

    fn resize_bilinear(&self, args: &ResizeArgs<'_>, output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has the AVX-512 extensions named there.
        unsafe { resize_bilinear::avx512(args, output) }
    }

    fn tokens(&self, args: &TokensArgs<'_>, output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has the AVX-512 extensions named there.
        unsafe { tokens::avx512(args, output) }
    }

    fn layer_norm(&self, args: &LayerNormArgs<'_>, input: Codes<'_>, output: CodesMut<'_>) {
        // SAFETY: the token proves that this machine has the AVX-512 extensions named there.
        unsafe { layer_norm::avx512(args, input, output) }
    }

    fn attention(
        &self,
        args: &AttentionArgs<'_>,
        query: Option<&[i8]>,
        key: &[i8],
        value: &[i8],
        output: CodesMut<'_>,
        scratch: &mut [u8],
    ) {
        // SAFETY: the token proves that this machine has the AVX-512 extensions named there.
        unsafe { attention::avx512(*self, args, query, key, value, output, scratch) }
    }
}
