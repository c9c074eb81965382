//! Seeded random numbers for tests: splitmix64, the same on every machine.

use firmware::image::known_answer::Generator;

/// A source of random numbers; print its seed where a test fails.
#[derive(Clone, Debug)]
pub struct Random(Generator);

impl Random {
    /// Starts with a seed.
    pub fn new(seed: u64) -> Self {
        Self(Generator::new(seed))
    }

    /// 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.0.draw()
    }

    /// A number below `bound`, which is not 0.
    pub fn below(&mut self, bound: usize) -> usize {
        (self.bits() % bound as u64) as usize
    }

    /// One of the elements of a slice that is not empty.
    pub fn pick<'a, T>(&mut self, from: &'a [T]) -> &'a T {
        &from[self.below(from.len())]
    }

    /// A value in [−1, 1), a multiple of 2⁻²³.
    pub fn signed_unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1 << 23) as f32 - 1.0
    }
}
