//! Conformance: the board's backend against the portable one, operator by operator, and the digest of all bytes
//! written, which the host's sweep over as large a workspace must give, too.

use crate::board::Bench;
use crate::counter::Counter;
use crate::machine::say;
use crate::uart::Uart;
use core::fmt::{self, Write};
use firmware::conformance::{self, Summary, WORKSPACE_BYTES};
use firmware::kernels::Kernels;

/// Seed of the sweep.
const SEED: u64 = 1;

/// Runs the sweep and answers the exit status: 0 the backend conforms, 1 not.
pub fn run<U: Uart, C: Counter, K: Kernels>(bench: &mut Bench<U, C, K>) -> u8 {
    u8::from(sweep(bench).is_err())
}

fn sweep<U: Uart, C: Counter, K: Kernels>(bench: &mut Bench<U, C, K>) -> fmt::Result {
    let Bench { machine, kernels, arena, .. } = bench;
    let bytes = arena.len().min(WORKSPACE_BYTES);
    let workspace = arena.get_mut(..bytes).unwrap_or_default();
    let Summary { cases, elements, left_out, digest } = say(machine, conformance::check(kernels, SEED, workspace))?;
    let name = machine.name;
    writeln!(
        machine,
        "{name}: seed {SEED}, workspace of {bytes} bytes: {cases} steps, {elements} elements equal, {left_out} steps \
         left out, digest {digest:08x}"
    )
}
