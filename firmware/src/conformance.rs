//! The conformance sweep: any backend against [`Portable`], operator by operator, over seeded random and extreme steps.
//!
//! It runs wherever the firmware runs: on a host, in an emulator, on silicon. Every array of a step is drawn on its
//! own, in one of several styles (random, all at one extreme, extremes in turn), within the bounds that the compiler
//! keeps; output, residual and scratch begin as garbage. A backend conforms if it writes the very bytes that `Portable`
//! writes. That `Portable` itself writes the same bytes on every instruction set is what [`Summary::digest`] tells.

use crate::image::known_answer::Generator;
use crate::image::{self, Digest};
use crate::kernels::{Kernels, Portable};
use crate::tensor::{CodesMut, ElementType};
use bytemuck::NoUninit;
use core::fmt;
use draw::{Buffer, Draw};

mod draw;
mod maps;
mod tokens;
mod weighted;

/// Working memory that every case of the sweep fits in.
pub const WORKSPACE_BYTES: usize = 1 << 20;

/// What a sweep compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Summary {
    /// Steps.
    pub cases: u32,
    /// Elements of their outputs.
    pub elements: u64,
    /// Steps that did not fit in the workspace.
    pub left_out: u32,
    /// CRC-32 of what the backend wrote, step after step: equal on every machine for the same seed, length of the
    /// workspace (which starts at a multiple of 16) and kernels.
    pub digest: u32,
}

/// The first difference of a sweep. The same seed finds it again.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mismatch {
    /// Operator, as [`crate::program::Step::name`] gives it.
    pub operator: &'static str,
    /// Seed of the sweep.
    pub seed: u64,
    /// Number of the case among those of its operator.
    pub case: u32,
    /// Shapes and what else tells the case from others.
    pub shapes: Shapes,
    /// Element of the output.
    pub index: usize,
    /// What the backend wrote.
    pub found: i32,
    /// What `Portable` wrote.
    pub expected: i32,
}

/// Description of a case; cut where it does not fit.
pub type Shapes = heapless::String<320>;

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { operator, seed, case, shapes, index, found, expected } = self;
        write!(
            f,
            "{operator}, case {case} of seed {seed:#x}, {shapes}: element {index} is {found}, expected {expected}"
        )
    }
}

impl core::error::Error for Mismatch {}

/// A kind of step in the sweep.
struct Operator {
    name: &'static str,
    cases: u32,
    /// Draws and compares a case of this number.
    run: fn(&mut Case<'_>, u32) -> Outcome,
}

/// `None`: the case does not fit in the workspace. Otherwise the elements compared.
type Outcome = Option<Result<usize, Difference>>;

/// An element that differs.
struct Difference {
    index: usize,
    found: i32,
    expected: i32,
}

/// Every operator of the image format that has a kernel (a branch linear layer runs that of a linear layer).
const OPERATORS: [Operator; 18] = [
    Operator { name: "conv2d", cases: 3000, run: weighted::conv2d },
    Operator { name: "linear", cases: 3000, run: weighted::linear },
    Operator { name: "max_pool", cases: 1000, run: maps::max_pool },
    Operator { name: "average_pool", cases: 1000, run: maps::average_pool },
    Operator { name: "global_pool", cases: 600, run: maps::global_pool },
    Operator { name: "add", cases: 1000, run: maps::add },
    Operator { name: "requantize", cases: 1000, run: maps::requantize },
    Operator { name: "resize_bilinear", cases: 600, run: maps::resize_bilinear },
    Operator { name: "tokens", cases: 600, run: tokens::tokens },
    Operator { name: "layer_norm", cases: 1000, run: tokens::layer_norm },
    Operator { name: "attention", cases: 600, run: tokens::attention },
    Operator { name: "waypoint_decoder", cases: 300, run: tokens::waypoint_decoder },
    Operator { name: "copy_box", cases: 600, run: maps::copy_box },
    Operator { name: "concat", cases: 600, run: maps::concat },
    Operator { name: "softmax", cases: 600, run: tokens::softmax },
    Operator { name: "gather_sum", cases: 600, run: maps::gather_sum },
    Operator { name: "sigmoid", cases: 600, run: tokens::sigmoid },
    Operator { name: "spatial_softmax", cases: 300, run: tokens::spatial_softmax },
];

/// Compares a backend with [`Portable`]. `workspace`: [`WORKSPACE_BYTES`]; what does not fit in a smaller one is left
/// out and counted.
///
/// # Errors
/// The first element that differs.
#[expect(clippy::result_large_err, reason = "one a sweep, and there is no heap")]
pub fn check(kernels: &dyn Kernels, seed: u64, workspace: &mut [u8]) -> Result<Summary, Mismatch> {
    let mut summary = Summary::default();
    let mut seeds = Generator::new(seed);
    let mut digest = image::digest();
    for operator in &OPERATORS {
        for number in 0..operator.cases {
            let draw = Draw::new(Generator::new(seeds.draw()), workspace);
            let mut case = Case { draw, kernels, shapes: Shapes::new(), digest: &mut digest };
            match (operator.run)(&mut case, number) {
                None => summary.left_out += 1,
                Some(Ok(elements)) => {
                    summary.cases += 1;
                    summary.elements += elements as u64;
                }
                Some(Err(Difference { index, found, expected })) => {
                    let (operator, shapes) = (operator.name, case.shapes);
                    return Err(Mismatch { operator, seed, case: number, shapes, index, found, expected });
                }
            }
        }
    }
    summary.digest = digest.finalize();
    Ok(summary)
}

/// A step under comparison.
struct Case<'m> {
    draw: Draw<'m>,
    kernels: &'m dyn Kernels,
    shapes: Shapes,
    /// Of what the backend wrote so far.
    digest: &'m mut Digest,
}

impl Case<'_> {
    /// Says what the case is, for a mismatch.
    fn describe(&mut self, shapes: fmt::Arguments<'_>) {
        // A description that does not fit is cut.
        let _ = fmt::write(&mut self.shapes, shapes);
    }

    /// Runs a step on both backends, each on its own copy of `output`, and compares the first `elements`.
    fn compare(
        &mut self,
        output: Buffer<'_>,
        elements: usize,
        mut step: impl FnMut(&dyn Kernels, CodesMut<'_>),
    ) -> Outcome {
        let mut expected = output;
        let mut found = Buffer { element: expected.element, bytes: self.draw.take(expected.bytes.len())? };
        found.bytes.copy_from_slice(expected.bytes);
        step(&Portable, expected.codes_mut()?);
        step(self.kernels, found.codes_mut()?);
        match (found.codes_mut()?, expected.codes_mut()?) {
            (CodesMut::I8(found), CodesMut::I8(expected)) => self.judge(found, expected, elements),
            (CodesMut::I16(found), CodesMut::I16(expected)) => self.judge(found, expected, elements),
            _ => None,
        }
    }

    /// Compares the first `elements`, and adds what was found to the digest.
    fn judge<T: NoUninit + Into<i32>>(&mut self, found: &[T], expected: &[T], elements: usize) -> Outcome {
        self.digest.update(bytemuck::cast_slice(found.get(..elements)?));
        Some(first_difference(found, expected, elements).map_or(Ok(elements), Err))
    }
}

/// The first of `elements` that differ.
fn first_difference<T: Copy + Into<i32>>(found: &[T], expected: &[T], elements: usize) -> Option<Difference> {
    let pairs = found.iter().zip(expected).map(|(found, expected)| ((*found).into(), (*expected).into()));
    let (index, (found, expected)) =
        pairs.take(elements).enumerate().find(|(_, (found, expected))| found != expected)?;
    Some(Difference { index, found, expected })
}

/// Largest magnitude bits of a code.
const fn code_bits(element: ElementType) -> u32 {
    match element {
        ElementType::I8 => 7,
        ElementType::I16 | ElementType::I32 | ElementType::Scratch => 15,
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use crate::kernels::LayerNormArgs;
    use crate::program::KernelId;
    use crate::tensor::Codes;
    use std::string::ToString;
    use std::vec;

    const SEED: u64 = 1;

    #[test]
    fn portable_conforms_to_itself_and_nothing_is_left_out() {
        let summary = check(&Portable, SEED, &mut vec![0; WORKSPACE_BYTES]).unwrap_or_else(|e| panic!("{e}"));
        let cases: u32 = OPERATORS.iter().map(|operator| operator.cases).sum();
        assert_eq!((summary.cases, summary.left_out), (cases, 0));
        assert!(summary.elements > 1_000_000, "{summary:?}");
    }

    #[test]
    fn the_digest_follows_the_bytes() {
        let mut workspace = vec![0; 20_000];
        let mut digest =
            |seed| check(&Portable, seed, &mut workspace).unwrap_or_else(|mismatch| panic!("{mismatch}")).digest;
        assert_eq!(digest(SEED), digest(SEED), "the garbage in the workspace takes no part");
        assert_ne!(digest(SEED), digest(SEED + 1));
    }

    #[test]
    fn a_small_workspace_leaves_cases_out() {
        let summary = check(&Portable, SEED, &mut vec![0; 20_000]).unwrap_or_else(|e| panic!("{e}"));
        assert!(summary.left_out > 0 && summary.cases > summary.left_out, "{summary:?}");
    }

    /// Wrong in one element of one operator.
    struct OffByOne;

    impl Kernels for OffByOne {
        fn supported(&self) -> &'static [KernelId] {
            KernelId::ALL
        }

        fn layer_norm(&self, args: &LayerNormArgs<'_>, input: Codes<'_>, output: CodesMut<'_>) {
            match output {
                CodesMut::I8(output) => {
                    Portable.layer_norm(args, input, CodesMut::I8(output));
                    output.last_mut().into_iter().for_each(|code| *code ^= 1);
                }
                CodesMut::I16(output) => Portable.layer_norm(args, input, CodesMut::I16(output)),
            }
        }
    }

    #[test]
    fn a_wrong_element_is_found_and_named() {
        let mut workspace = vec![0; WORKSPACE_BYTES];
        let mismatch = check(&OffByOne, SEED, &mut workspace).expect_err("a difference");
        assert_eq!(mismatch.operator, "layer_norm");
        assert_eq!(mismatch.found, mismatch.expected ^ 1);
        let text = mismatch.to_string();
        assert!(text.starts_with("layer_norm, case ") && text.contains("rows of"), "{text}");
        assert_eq!(check(&OffByOne, SEED, &mut workspace), Err(mismatch), "the seed finds it again");
    }
}
