//! The bounded functions of gates, from one table.

use super::arithmetic::{Exactness, RoundingShift, power_of_two, to_f64};
use super::operands::expect;
use crate::error::Result;

/// One in Q15, which σ approaches but does not reach.
const ONE: f64 = 32768.0;

/// tanh and σ by linear interpolation of one table, x in Q12, result in Q15.
pub(super) struct Gates {
    /// `T[k] = min(32767, round(2^15·tanh(k/64)))`, k = 0..=512.
    table: Vec<f64>,
}

impl Gates {
    pub(super) fn new(table: &[i16]) -> Result<Self> {
        expect("entries of the tanh table", table.len(), 513)?;
        Ok(Self { table: to_f64(table) })
    }

    pub(super) fn tanh(&self, x: f64, exact: &mut Exactness) -> f64 {
        self.interpolate(x, 6, exact)
    }

    /// `σ(x) = (1 + tanh(x/2)) / 2`.
    pub(super) fn sigmoid(&self, x: f64, exact: &mut Exactness) -> f64 {
        let half = self.interpolate(x, 7, exact);
        RoundingShift::new(1).round(ONE + half, exact).min(ONE - 1.0)
    }

    /// `±R(T[k]·2^b + (T[k+1] − T[k])·r, b)`, `k = a >> b`, r the low b bits of `a = min(|x|, 2^(b+9) − 1)`.
    fn interpolate(&self, x: f64, index_shift: u32, exact: &mut Exactness) -> f64 {
        let spacing = power_of_two(index_shift as i32);
        let a = exact.watch(x).abs().min(512.0 * spacing - 1.0);
        let k = (a / spacing).floor();
        let r = a - k * spacing;
        let (low, high) = (self.table[k as usize], self.table[k as usize + 1]);
        let y = RoundingShift::new(index_shift).round(low * spacing + (high - low) * r, exact);
        if x < 0.0 { -y } else { y }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quantize::tables::tanh_table;

    #[test]
    fn gates_are_monotone_symmetric_and_close() {
        let gates = Gates::new(&tanh_table()).unwrap();
        let mut exact = Exactness::default();
        let mut last = (-32769.0, -1.0);
        for x in -70_000..=70_000 {
            let (code, real) = (f64::from(x), f64::from(x) / 4096.0);
            let (tanh, sigmoid) = (gates.tanh(code, &mut exact), gates.sigmoid(code, &mut exact));
            assert!(tanh >= last.0 && sigmoid >= last.1, "x = {x}");
            assert_eq!(gates.tanh(-code, &mut exact), -tanh, "x = {x}");
            assert!((tanh - 32768.0 * real.tanh()).abs() < 1.8, "x = {x}: {tanh}");
            assert!((sigmoid - 32768.0 / (1.0 + (-real).exp())).abs() < 1.5, "x = {x}: {sigmoid}");
            let mirrored = sigmoid + gates.sigmoid(-code, &mut exact);
            assert!((mirrored - 32768.0).abs() <= 1.0, "x = {x}: {mirrored}");
            last = (tanh, sigmoid);
        }
        assert_eq!((gates.tanh(0.0, &mut exact), gates.sigmoid(0.0, &mut exact)), (0.0, 16384.0));
        // Far outside: the table's end, never a wrap.
        assert_eq!((gates.tanh(-1e12, &mut exact), gates.sigmoid(1e12, &mut exact)), (-32767.0, 32767.0));
        assert_eq!(gates.sigmoid(-1e12, &mut exact), 1.0);
    }
}
