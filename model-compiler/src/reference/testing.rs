//! Seeded values and comparison for the tests of the interpreter.

/// `count` values in [-1, 1), a pure function of the seed (splitmix64).
pub(super) fn values(seed: u64, count: usize) -> Vec<f32> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (state ^ (state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    };
    (0..count).map(|_| (next() >> 40) as f32 / 8_388_608.0 - 1.0).collect()
}

/// Panics where an element differs by more than `tolerance`, or where one is not a number.
pub(super) fn assert_close(found: &[f32], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len(), "length");
    for (i, (&f, &e)) in found.iter().zip(expected).enumerate() {
        let close = (f64::from(f) - e).abs() <= tolerance;
        assert!(close, "element {i}: found {f}, expected {e}");
    }
}
