//! Tables of the nonlinear functions and of the resize weights.

use super::factors::round;

/// `T[k] = min(32767, round(2^15·2^(−k/256)))`, k = 0..=256.
pub fn exp2_table() -> Vec<i16> {
    (0..=256).map(|k| round(32768.0 * f64::exp2(-f64::from(k) / 256.0)).min(32767.0) as i16).collect()
}

/// `T[k] = min(32767, round(2^15·tanh(k/64)))`, k = 0..=512.
pub fn tanh_table() -> Vec<i16> {
    (0..=512).map(|k| round(32768.0 * f64::tanh(f64::from(k) / 64.0)).min(32767.0) as i16).collect()
}

/// Fraction bits of the bilinear weights: 4 where every weight is exact (×2, ×4, ×8), else 11.
pub fn resize_weight_bits(factors: [u16; 2]) -> u8 {
    if factors.iter().all(|f| matches!(f, 1 | 2 | 4 | 8)) { 4 } else { 11 }
}

/// `[i0, w1]` per output index of one axis, half-pixel centers: `src = max((d + ½)·in/out − ½, 0)`.
pub fn resize_axis(input: u16, output: u16, weight_bits: u8) -> Vec<[u16; 2]> {
    let last = f64::from(input.max(1) - 1);
    let ratio = f64::from(input) / f64::from(output);
    (0..output)
        .map(|d| {
            let source = ((f64::from(d) + 0.5) * ratio - 0.5).max(0.0);
            let first = source.floor().min(last);
            [first as u16, round((source - first) * f64::exp2(f64::from(weight_bits))) as u16]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_start_at_full_scale_and_fall_or_rise() {
        let e = exp2_table();
        assert_eq!((e.len(), e[0], e[256]), (257, 32767, 16384));
        assert!(e.windows(2).all(|w| w[1] <= w[0]));
        let t = tanh_table();
        assert_eq!((t.len(), t[0], t[512]), (513, 0, 32767));
        assert!(t.windows(2).all(|w| w[1] >= w[0]));
    }

    #[test]
    fn resize_weights_of_small_factors_are_exact() {
        assert_eq!(resize_axis(8, 16, 4)[..4], [[0, 0], [0, 4], [0, 12], [1, 4]]);
        let eight = resize_axis(8, 64, 4);
        assert_eq!(eight[..5], [[0, 0], [0, 0], [0, 0], [0, 0], [0, 1]]);
        assert_eq!(eight[63], [7, 7]);
        assert_eq!(resize_axis(8, 8, 4), (0..8).map(|i| [i, 0]).collect::<Vec<_>>());
    }
}
