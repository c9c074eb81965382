//! What Arm's MPS2 boards with a Cortex-M have in common.

use crate::counter::CmsdkTimer;
use crate::machine::Machine;
use crate::uart::CmsdkUart;

const UART: usize = 0x4000_4000;
const TIMER: usize = 0x4000_0000;
const TIMER_HERTZ: u64 = 25_000_000;

/// The board with its first UART and its first timer.
///
/// # Safety
/// The program runs on an MPS2 board, and calls this once.
pub unsafe fn machine(name: &'static str) -> Machine<CmsdkUart, CmsdkTimer> {
    // SAFETY: these devices lie there on every such board, and are made once.
    let (uart, counter) = unsafe { (CmsdkUart::new(UART), CmsdkTimer::new(TIMER, TIMER_HERTZ)) };
    Machine { name, uart, counter }
}
