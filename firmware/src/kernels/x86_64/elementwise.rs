//! Element-wise operators for AVX2 and AVX-512: [`portable::elementwise`] in vectors, for every type and length.

use super::sums::{Aligned, BLOCK, Ending, add_term};
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
        let mut sums = Aligned([0; BLOCK]);
        for term in terms {
            add_term(&mut sums.0, term, i * BLOCK, codes);
        }
        ending.write(&sums.0, codes);
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

#[cfg(test)]
mod tests {
    use super::super::testing::{code_bits, for_backends, multiplier, requant, sum, zero_point};
    use crate::kernels::{Kernels, Portable, TermArgs};

    #[test]
    fn add_equals_portable_with_operands_apart_and_in_place() {
        for_backends(500, |kernels, rng| {
            let output_type = rng.element_type();
            let len = rng.range(1, 700) as usize;
            let in_place = [rng.flag(), rng.flag()];
            let types = in_place.map(|in_place| if in_place { output_type } else { rng.element_type() });
            let initial = rng.buffer(output_type, len);
            let apart = types.map(|t| rng.buffer(t, len));
            let terms = [0, 1].map(|k| TermArgs {
                codes: (!in_place[k]).then(|| apart[k].codes()),
                zero_point: zero_point(rng, types[k]),
                multiplier: multiplier(rng),
            });
            let sum = sum(rng, output_type);
            let (mut expected, mut output) = (initial.clone(), initial);
            Portable.add(&sum, &terms, expected.codes_mut());
            kernels.add(&sum, &terms, output.codes_mut());
            assert_eq!(output, expected, "{sum:?} {terms:?}");
        });
    }

    #[test]
    fn requantize_equals_portable() {
        for_backends(500, |kernels, rng| {
            let (from, to) = (rng.element_type(), rng.element_type());
            let len = rng.range(1, 300) as usize;
            let input = rng.buffer(from, len);
            let args = requant(rng, from, code_bits(from), to);
            let mut expected = rng.buffer(to, len);
            let mut output = expected.clone();
            Portable.requantize(&args, input.codes(), expected.codes_mut());
            kernels.requantize(&args, input.codes(), output.codes_mut());
            assert_eq!(output, expected, "{args:?}");
        });
    }

    #[test]
    fn operands_of_another_length_leave_the_output_alone() {
        for_backends(50, |kernels, rng| {
            let (from, to) = (rng.element_type(), rng.element_type());
            let len = rng.range(1, 40) as usize;
            let other = rng.buffer(from, len + 1);
            let term = |codes| TermArgs { codes, zero_point: 0, multiplier: 1 };
            let before = rng.buffer(to, len);
            let mut output = before.clone();
            let end = sum(rng, to);
            kernels.add(&end, &[term(None), term(Some(other.codes()))], output.codes_mut());
            kernels.requantize(&requant(rng, from, 8, to), other.codes(), output.codes_mut());
            assert_eq!(output, before);
        });
    }
}
