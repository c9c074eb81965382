//! Portable concatenation.

use super::codes::{Code, block, operand_len, value};
use crate::fault::{self, Fault};
use crate::kernels::{ConcatSourceArgs, RequantArgs};
use crate::program::{Axis, Clamp, Requant};
use crate::tensor::{Codes, CodesMut};

/// A factor of exactly one.
const ONE: Requant = Requant { multiplier: 1 << 23, shift: 23 };

/// The sources one behind the other along an axis, each code as `clamp(z_o + R((q − z)·M, n))`.
///
/// Sources: i8 or i16 maps, equal in the other two axes; `output`: i8 or i16 map. M in `[2^23, 2^24)`, n in 1..=52.
pub fn concat(axis: Axis, sources: &[ConcatSourceArgs<'_>; 2], output: CodesMut<'_>) {
    match output {
        CodesMut::I8(output) => concat_into(axis, sources, output),
        CodesMut::I16(output) => concat_into(axis, sources, output),
    }
}

fn concat_into<T: Code>(axis: Axis, sources: &[ConcatSourceArgs<'_>; 2], output: &mut [T]) {
    let [mut first, mut second] = sources.each_ref();
    if fault::active(Fault::ConcatOrder) {
        core::mem::swap(&mut first, &mut second);
    }
    let [Some(first_run), Some(second_run)] = [run(axis, first), run(axis, second)] else { return };
    let elements = first.shape.elements().saturating_add(second.shape.elements());
    if elements != output.len() as u64 {
        return;
    }
    let both = first_run.saturating_add(second_run).max(1);
    for (index, part) in output.chunks_mut(both).enumerate() {
        let Some((front, behind)) = part.split_at_mut_checked(first_run) else { return };
        write(first, index, front);
        write(second, index, behind);
    }
}

/// Length of a source's runs; `None` where they are empty or its codes are not those of its shape.
fn run(axis: Axis, source: &ConcatSourceArgs<'_>) -> Option<usize> {
    let run = usize::try_from(axis.run(source.shape)).ok()?;
    (run > 0 && source.shape.elements() == operand_len(Some(source.codes), 0) as u64).then_some(run)
}

/// Run number `index` of a source.
fn write<T: Code>(source: &ConcatSourceArgs<'_>, index: usize, output: &mut [T]) {
    match source.codes {
        Codes::I8(codes) => write_run(&source.requant, codes, index, output),
        Codes::I16(codes) => write_run(&source.requant, codes, index, output),
    }
}

fn write_run<I: Code, O: Code>(requant: &RequantArgs, codes: &[I], index: usize, output: &mut [O]) {
    let Some(codes) = block(codes, index, output.len()) else { return };
    if requant.requant == ONE && requant.zero_point == requant.input_zero_point {
        let Clamp { min, max } = requant.clamp;
        for (code, q) in output.iter_mut().zip(codes) {
            *code = O::from_code(q.widen().max(min).min(max));
        }
        return;
    }
    for (code, q) in output.iter_mut().zip(codes) {
        *code = requant.code(value(*q) - i64::from(requant.input_zero_point));
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::{Buffer, clamp, for_seeds, round};
    use super::*;
    use crate::tensor::{ElementType, Shape};
    use std::vec::Vec;

    fn expected(axis: Axis, sources: &[ConcatSourceArgs<'_>; 2], maps: &[Buffer; 2], output: Shape) -> Vec<i128> {
        let place = |at: usize| {
            let (width, channels) = (usize::from(output.width), usize::from(output.channels));
            let mut place = [at / channels / width, at / channels % width, at % channels];
            let meet = match axis {
                Axis::Height => usize::from(sources[0].shape.height),
                Axis::Width => usize::from(sources[0].shape.width),
                Axis::Channels => usize::from(sources[0].shape.channels),
            };
            let along = &mut place[axis as usize];
            let number = usize::from(*along >= meet);
            *along -= number * meet;
            let shape = sources[number].shape;
            (number, (place[0] * usize::from(shape.width) + place[1]) * usize::from(shape.channels) + place[2])
        };
        let code = |at: usize| {
            let (number, element) = place(at);
            let args = sources[number].requant;
            let product =
                (maps[number].get(element) - i128::from(args.input_zero_point)) * i128::from(args.requant.multiplier);
            clamp(i128::from(args.zero_point) + round(product, args.requant.shift.into()), args.clamp)
        };
        (0..output.elements() as usize).map(code).collect()
    }

    #[test]
    fn equals_the_formula_along_every_axis() {
        for_seeds(400, |rng| {
            let axis = [Axis::Height, Axis::Width, Axis::Channels][rng.range(0, 2) as usize];
            let first = Shape::map(rng.range(1, 5) as u16, rng.range(1, 5) as u16, rng.range(1, 20) as u16);
            let (mut second, mut output) = (first, first);
            let more = rng.range(1, 7) as u16;
            let [along_second, along_output] = [&mut second, &mut output].map(|shape| match axis {
                Axis::Height => &mut shape.height,
                Axis::Width => &mut shape.width,
                Axis::Channels => &mut shape.channels,
            });
            *along_second = more;
            *along_output += more;
            let to = rng.element_type();
            let (zero_point, bounds) = (rng.zero_point(to), rng.clamp(to));
            let bits = |t| if t == ElementType::I8 { 8 } else { 16 };
            let types = [rng.element_type(), rng.element_type()];
            let maps = [0, 1].map(|k| rng.buffer(types[k], [first, second][k].elements() as usize));
            let mut source = |k: usize| {
                let exact = types[k] == to && rng.flag();
                let other = RequantArgs {
                    input_zero_point: rng.zero_point(types[k]),
                    requant: rng.requant(bits(types[k]), bits(to)),
                    zero_point,
                    clamp: bounds,
                };
                let equal = RequantArgs { input_zero_point: zero_point, requant: ONE, ..other };
                ConcatSourceArgs {
                    codes: maps[k].codes(),
                    shape: [first, second][k],
                    requant: if exact { equal } else { other },
                }
            };
            let sources = [source(0), source(1)];
            let mut result = rng.buffer(to, output.elements() as usize);
            concat(axis, &sources, result.codes_mut());
            result.assert_equals(&expected(axis, &sources, &maps, output), "concat");
        });
    }

    #[test]
    fn hostile_constants_and_lengths_do_not_panic() {
        let clamp = Clamp { min: 1, max: -1 };
        let requant = Requant { multiplier: i32::MIN, shift: 255 };
        let requant = RequantArgs { input_zero_point: i16::MIN, requant, zero_point: i16::MIN, clamp };
        let source = ConcatSourceArgs { codes: Codes::I16(&[i16::MAX; 4]), shape: Shape::map(1, 2, 2), requant };
        for second in [
            source,
            ConcatSourceArgs { requant: RequantArgs { requant: ONE, ..requant }, ..source },
            ConcatSourceArgs { shape: Shape::map(0, 2, 2), codes: Codes::I8(&[]), ..source },
            ConcatSourceArgs { shape: Shape::map(u16::MAX, u16::MAX, u16::MAX), ..source },
            ConcatSourceArgs { codes: Codes::I8(&[1; 3]), ..source },
        ] {
            for axis in [Axis::Height, Axis::Width, Axis::Channels] {
                concat(axis, &[source, second], CodesMut::I8(&mut [0; 8]));
                concat(axis, &[second, source], CodesMut::I16(&mut [0; 8]));
                concat(axis, &[source, source], CodesMut::I16(&mut [0; 3]));
            }
        }
    }
}
