//! The checks of a board, one a run; the command line says which.

use super::{conformance, measure, self_test};
use crate::board::Bench;
use crate::counter::Counter;
use crate::semihosting;
use crate::uart::Uart;
use core::fmt::Write;
use firmware::kernels::Kernels;

/// Longest command line, bytes.
const COMMAND_LINE_BYTES: usize = 1024;

/// Runs the check that the last word of the command line names (`self-test`, `conformance`, `measure`), or the self-test where the line only
/// holds the program's own path.
pub fn run<U: Uart, C: Counter, K: Kernels + Copy>(bench: &mut Bench<U, C, K>) -> u8 {
    let mut memory = [0; COMMAND_LINE_BYTES];
    let line = semihosting::command_line(&mut memory).unwrap_or_default();
    match line.rsplit(' ').next().unwrap_or_default() {
        "self-test" => self_test::run(bench),
        "conformance" => conformance::run(bench),
        "measure" => measure::run(bench),
        path if path.is_empty() || path.ends_with("-check") => self_test::run(bench),
        other => {
            let name = bench.machine.name;
            let _ = writeln!(
                bench.machine,
                "{name}: no check is called {other}; there are self-test, conformance and measure"
            );
            2
        }
    }
}
