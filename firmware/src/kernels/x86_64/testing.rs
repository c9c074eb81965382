//! What the tests of the x86-64 kernels share: every backend that this machine has, and constants both as a compiler
//! writes them and wild, for all of which a backend equals the norm.

extern crate std;

use super::{Avx2, Avx512Vnni};
use crate::kernels::portable::oracle::{Rng, for_seeds};
use crate::kernels::{Kernels, RequantArgs, SumArgs};
use crate::program::{Clamp, Requant};
use crate::tensor::ElementType;

/// Runs `test` for `cases` seeds with each backend that this machine has, and says which it has not.
pub(super) fn for_backends(cases: u64, test: impl Fn(&dyn Kernels, &mut Rng)) {
    let run = |name: &str, kernels: Option<&dyn Kernels>| match kernels {
        Some(kernels) => {
            std::println!("{name}");
            for_seeds(cases, |rng| test(kernels, rng));
        }
        None => std::println!("{name}: not run, this machine lacks the instructions"),
    };
    run("AVX2", Avx2::detect().as_ref().map(|kernels| kernels as &dyn Kernels));
    run("AVX-512 with VNNI", Avx512Vnni::detect().as_ref().map(|kernels| kernels as &dyn Kernels));
}

/// End of a sum, one in four wild.
pub(super) fn sum(rng: &mut Rng, output: ElementType) -> SumArgs {
    if rng.next().is_multiple_of(4) {
        return SumArgs { shift: rng.range(0, 300) as u32, zero_point: code(rng), clamp: wild_clamp(rng) };
    }
    SumArgs { shift: rng.range(16, 40) as u32, zero_point: rng.zero_point(output), clamp: rng.clamp(output) }
}

/// Epilogue of sums of about `bits` digits, one in four wild.
pub(super) fn requant(rng: &mut Rng, input: ElementType, bits: i64, output: ElementType) -> RequantArgs {
    if rng.next().is_multiple_of(4) {
        return RequantArgs {
            input_zero_point: code(rng),
            requant: Requant { multiplier: multiplier(rng), shift: rng.range(0, 255) as u8 },
            zero_point: code(rng),
            clamp: wild_clamp(rng),
        };
    }
    RequantArgs {
        input_zero_point: rng.zero_point(input),
        requant: rng.requant(bits, if output == ElementType::I8 { 7 } else { 15 }),
        zero_point: rng.zero_point(output),
        clamp: rng.clamp(output),
    }
}

/// Any multiplier of a term, now and then an extreme one.
pub(super) fn multiplier(rng: &mut Rng) -> i32 {
    match rng.next() % 8 {
        0 => i32::MIN,
        1 => i32::MAX,
        2 => rng.range(i32::MIN.into(), i32::MAX.into()) as i32,
        _ => rng.range(1, 1 << 24) as i32,
    }
}

/// Zero point of an operand, one in eight wild.
pub(super) fn zero_point(rng: &mut Rng, operand: ElementType) -> i16 {
    if rng.next().is_multiple_of(8) { code(rng) } else { rng.zero_point(operand) }
}

/// Digits of the codes of a type.
pub(super) fn code_bits(element: ElementType) -> i64 {
    i64::from(element.bytes()) * 8
}

fn code(rng: &mut Rng) -> i16 {
    rng.range(i16::MIN.into(), i16::MAX.into()) as i16
}

fn wild_clamp(rng: &mut Rng) -> Clamp {
    Clamp { min: code(rng), max: code(rng) }
}
