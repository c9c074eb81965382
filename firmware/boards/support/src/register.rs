//! Memory-mapped registers.

/// A 32-bit register at a fixed address.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Register(*mut u32);

impl Register {
    /// The register at this address.
    ///
    /// # Safety
    /// A device register of the machine lies there: it may be read and written at any time without harm to memory.
    pub const unsafe fn at(address: usize) -> Self {
        Self(address as *mut u32)
    }

    /// Its value.
    pub fn read(self) -> u32 {
        // SAFETY: `at` demands a device register here.
        unsafe { self.0.read_volatile() }
    }

    /// Sets its value.
    pub fn write(self, value: u32) {
        // SAFETY: `at` demands a device register here.
        unsafe { self.0.write_volatile(value) }
    }
}
