//! Codes of the inputs: from raw values, and the seeded ones of the known-answer test.

use super::arithmetic::saturate_i16;
use crate::ir::InputKind;
use crate::qmodel::{Port, QModel};
use firmware::tensor::ElementType;

/// Codes of one input from raw values (numerics, "Inputs").
///
/// Raw units: an image holds 0..=255, a BEV histogram counts 0..=5, the velocity is in m/s and the goal in m. Images
/// become `u8 − 128` and counts stay as they are (both saturate, and a fraction rounds to the nearest integer, ties up,
/// though none is expected); velocity becomes i16 Q8, the goal i32 Q16, both by `floor(2^k·x + ½)`, saturated.
pub fn encode_input(kind: InputKind, raw: &[f64]) -> Vec<f64> {
    let round = |x: f64| (x + 0.5).floor();
    let code = |&x: &f64| match kind {
        InputKind::Image => round(x).clamp(0.0, 255.0) - 128.0,
        InputKind::Bev => round(x).clamp(0.0, 5.0),
        InputKind::Velocity => saturate_i16(round(256.0 * x)),
        InputKind::Goal => round(65536.0 * x).clamp(-2147483648.0, 2147483647.0),
    };
    raw.iter().map(code).collect()
}

/// Input codes of the known-answer test, a function of the model's inputs and a seed.
///
/// The rule, for anyone who writes it again: element `i` (from 0, in memory order) of input number `k` (from 0, in
/// the order of the model's inputs) draws the 64-bit word
///
/// ```text
/// w = splitmix64(seed XOR (k·2^32 + i))
/// splitmix64(s): z = s + 0x9E3779B97F4A7C15
///                z = (z XOR (z >> 30)) · 0xBF58476D1CE4E5B9
///                z = (z XOR (z >> 27)) · 0x94D049BB133111EB
///                z XOR (z >> 31)                               all modulo 2^64, shifts logical
/// ```
///
/// and becomes a code by the element type of the input:
/// * BEV (an input of [`InputKind::Bev`]): the low 8 bits of w, as 0..=255, modulo 6
/// * any other i8 input (image): the low 8 bits of w as a two's-complement byte, −128..=127
/// * i16 (velocity): the low 12 bits of w, 0..=4095 (below 16 m/s)
/// * i32 (goal): the low 23 bits of w minus 2^22 (−64 m up to just below 64 m)
///
/// # Panics
/// Where an input is scratch memory.
pub fn known_answer_inputs(model: &QModel, seed: u64) -> Vec<Vec<f64>> {
    let codes = |(number, port): (usize, &Port)| {
        let tensor = model.tensor(port.tensor);
        let first = (number as u64) << 32;
        let words = (0..tensor.shape.elements()).map(|i| splitmix64(seed ^ (first + i)));
        words.map(|word| known_answer_code(tensor.element, port.kind, word)).collect()
    };
    model.inputs.iter().enumerate().map(codes).collect()
}

fn known_answer_code(element: ElementType, kind: Option<InputKind>, word: u64) -> f64 {
    match element {
        ElementType::I8 if kind == Some(InputKind::Bev) => f64::from(word as u8 % 6),
        ElementType::I8 => f64::from(word as u8 as i8),
        ElementType::I16 => (word & 0xfff) as f64,
        ElementType::I32 => (word & 0x7f_ffff) as f64 - 4194304.0,
        ElementType::Scratch => panic!("scratch memory is no input"),
    }
}

/// The finalizer of the SplitMix64 generator, used as a counter-based random function.
pub(super) fn splitmix64(state: u64) -> u64 {
    let z = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::integer_reference::testing;
    use firmware::tensor::Shape;

    #[test]
    fn raw_values_become_codes() {
        assert_eq!(encode_input(InputKind::Image, &[0.0, 128.0, 255.0]), [-128.0, 0.0, 127.0]);
        assert_eq!(encode_input(InputKind::Bev, &[0.0, 3.0, 5.0]), [0.0, 3.0, 5.0]);
        let speeds = [0.0, 1.0 / 512.0, -1.0 / 512.0, 5.3, 127.999, 128.0, -200.0];
        let codes = [0.0, 1.0, 0.0, 1357.0, 32767.0, 32767.0, -32768.0];
        assert_eq!(encode_input(InputKind::Velocity, &speeds), codes);
        let goals = [0.5, -1.0 / 131072.0, 1.0 / 131072.0, -12.25, 40000.0, -40000.0];
        let codes = [32768.0, 0.0, 1.0, -802816.0, 2147483647.0, -2147483648.0];
        assert_eq!(encode_input(InputKind::Goal, &goals), codes);
    }

    #[test]
    fn splitmix64_gives_the_published_sequence() {
        let increment = 0x9e37_79b9_7f4a_7c15u64;
        let published = [0x599e_d017_fb08_fc85, 0x2c73_f084_5854_0fa5, 0x883e_bce5_a3f2_7c77];
        let states = (0..3u64).map(|i| increment.wrapping_mul(i).wrapping_add(1_234_567));
        assert_eq!(states.map(splitmix64).collect::<Vec<_>>(), published);
    }

    #[test]
    fn known_answer_inputs_follow_the_rule() {
        let mut model = testing::model(&[
            ("rgb", Shape::map(16, 16, 3), ElementType::I8),
            ("bev", Shape::map(16, 16, 2), ElementType::I8),
            ("velocity", Shape::vector(1), ElementType::I16),
            ("goal", Shape::vector(2), ElementType::I32),
        ]);
        let kinds = [InputKind::Image, InputKind::Bev, InputKind::Velocity, InputKind::Goal];
        let port = |(i, &kind): (usize, &InputKind)| testing::port("input", i as u32, Some(kind));
        model.inputs = kinds.iter().enumerate().map(port).collect();
        let seed = 0xfeed_0000_0000_0001;
        let inputs = known_answer_inputs(&model, seed);
        assert_eq!(inputs.iter().map(Vec::len).collect::<Vec<_>>(), [768, 512, 1, 2]);
        let word = |number: u64, i: u64| splitmix64(seed ^ (number * (1 << 32) + i));
        assert_eq!(inputs[0][7], f64::from(word(0, 7) as u8 as i8));
        assert_eq!(inputs[1][7], (word(1, 7) % 256 % 6) as f64);
        assert_eq!(inputs[2][0], (word(2, 0) % 4096) as f64);
        assert_eq!(inputs[3][1], (word(3, 1) % (1 << 23)) as f64 - f64::from(1 << 22));
        let range = |codes: &[f64]| codes.iter().fold((0f64, 0f64), |(lo, hi), &c| (lo.min(c), hi.max(c)));
        let (lo, hi) = range(&inputs[0]);
        assert!(lo < -120.0 && hi > 120.0, "an image uses the whole range, found {lo}..{hi}");
        assert_eq!(range(&inputs[1]), (0.0, 5.0));
        assert_ne!(known_answer_inputs(&model, seed + 1)[0], inputs[0]);
    }
}
