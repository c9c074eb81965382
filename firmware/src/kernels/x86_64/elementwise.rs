//! Element-wise operators for AVX2 and AVX-512: [`portable::elementwise`] in vectors, for every type and length.

use super::sums::{BLOCK, Ending, add_term};
use crate::kernels::portable::codes::{Code, operand_len};
use crate::kernels::{RequantArgs, SumArgs, TermArgs};
use crate::tensor::{Codes, CodesMut};

#[cfg(doc)]
use crate::kernels::portable;

/// [`portable::elementwise::add`] with AVX2.
#[target_feature(enable = "avx2")]
pub(super) fn add_avx2(sum: &SumArgs, terms: &[TermArgs<'_>; 2], output: CodesMut<'_>) {
    add(sum, terms, output);
}

/// [`portable::elementwise::add`] with AVX-512.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
pub(super) fn add_avx512(sum: &SumArgs, terms: &[TermArgs<'_>; 2], output: CodesMut<'_>) {
    add(sum, terms, output);
}

/// [`portable::elementwise::requantize`] with AVX2.
#[target_feature(enable = "avx2")]
pub(super) fn requantize_avx2(args: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
    requantize(args, input, output);
}

/// [`portable::elementwise::requantize`] with AVX-512.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
pub(super) fn requantize_avx512(args: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
    requantize(args, input, output);
}

#[inline(always)]
fn add(sum: &SumArgs, terms: &[TermArgs<'_>; 2], output: CodesMut<'_>) {
    match output {
        CodesMut::I8(output) => add_into(sum, terms, output),
        CodesMut::I16(output) => add_into(sum, terms, output),
    }
}

#[inline(always)]
fn add_into<T: Code>(sum: &SumArgs, terms: &[TermArgs<'_>; 2], output: &mut [T]) {
    let len = output.len();
    if terms.iter().any(|term| operand_len(term.codes, len) != len) {
        return;
    }
    let ending = Ending::of_sum(sum);
    for (i, codes) in output.chunks_mut(BLOCK).enumerate() {
        let mut sums = [0; BLOCK];
        for term in terms {
            add_term(&mut sums, term, i * BLOCK, codes);
        }
        ending.write(&sums, codes);
    }
}

#[inline(always)]
fn requantize(args: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
    match (input, output) {
        (Codes::I8(input), CodesMut::I8(output)) => requantize_into(args, input, output),
        (Codes::I8(input), CodesMut::I16(output)) => requantize_into(args, input, output),
        (Codes::I16(input), CodesMut::I8(output)) => requantize_into(args, input, output),
        (Codes::I16(input), CodesMut::I16(output)) => requantize_into(args, input, output),
    }
}

#[inline(always)]
fn requantize_into<I: Code, O: Code>(args: &RequantArgs, input: &[I], output: &mut [O]) {
    if input.len() != output.len() {
        return;
    }
    let ending = Ending::of_requant(args);
    for (code, q) in output.iter_mut().zip(input) {
        let difference = i32::from(q.widen()).wrapping_sub(args.input_zero_point.into());
        *code = ending.code(i64::from(difference).wrapping_mul(args.requant.multiplier.into()));
    }
}
