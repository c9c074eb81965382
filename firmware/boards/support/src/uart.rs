//! The UARTs of the emulated boards, polled.

use crate::register::Register;

/// A UART that sends and receives single bytes.
pub trait Uart {
    /// Waits for room and sends a byte.
    fn send(&mut self, byte: u8);

    /// A received byte, if there is one.
    fn receive(&mut self) -> Option<u8>;
}

/// APB UART of Arm's Cortex-M System Design Kit (mps2 and mps3 boards; Arm DDI 0479, section 4.3).
#[derive(Debug)]
pub struct CmsdkUart {
    data: Register,
    state: Register,
}

impl CmsdkUart {
    const TRANSMIT_FULL: u32 = 1 << 0;
    const RECEIVE_FULL: u32 = 1 << 1;
    const TRANSMIT_AND_RECEIVE: u32 = 0b11;

    /// Enables the UART at its fastest rate.
    ///
    /// # Safety
    /// Such a UART lies at this address, and nothing else drives it.
    pub unsafe fn new(base: usize) -> Self {
        // SAFETY: registers of the UART that the caller vouches for.
        let [data, state, control, divider] =
            unsafe { [Register::at(base), Register::at(base + 4), Register::at(base + 8), Register::at(base + 0x10)] };
        divider.write(16);
        control.write(Self::TRANSMIT_AND_RECEIVE);
        Self { data, state }
    }
}

impl Uart for CmsdkUart {
    fn send(&mut self, byte: u8) {
        while self.state.read() & Self::TRANSMIT_FULL != 0 {}
        self.data.write(byte.into());
    }

    fn receive(&mut self) -> Option<u8> {
        (self.state.read() & Self::RECEIVE_FULL != 0).then(|| self.data.read() as u8)
    }
}

/// PrimeCell UART (Arm DDI 0183), as a boot loader leaves it: enabled, FIFOs on.
#[derive(Debug)]
pub struct Pl011 {
    data: Register,
    flags: Register,
}

impl Pl011 {
    const RECEIVE_EMPTY: u32 = 1 << 4;
    const TRANSMIT_FULL: u32 = 1 << 5;
    const ENABLE: u32 = 1 << 0 | 1 << 8 | 1 << 9;
    const EIGHT_BITS_FIFO: u32 = 0b111 << 4;

    /// Enables the UART.
    ///
    /// # Safety
    /// Such a UART lies at this address, and nothing else drives it.
    pub unsafe fn new(base: usize) -> Self {
        // SAFETY: registers of the UART that the caller vouches for.
        let [data, flags, line, control] = unsafe {
            [Register::at(base), Register::at(base + 0x18), Register::at(base + 0x2C), Register::at(base + 0x30)]
        };
        line.write(Self::EIGHT_BITS_FIFO);
        control.write(Self::ENABLE);
        Self { data, flags }
    }
}

impl Uart for Pl011 {
    fn send(&mut self, byte: u8) {
        while self.flags.read() & Self::TRANSMIT_FULL != 0 {}
        self.data.write(byte.into());
    }

    fn receive(&mut self) -> Option<u8> {
        (self.flags.read() & Self::RECEIVE_EMPTY == 0).then(|| self.data.read() as u8)
    }
}
