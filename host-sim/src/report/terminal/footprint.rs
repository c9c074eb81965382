//! What firmware takes, as text.

use super::table;
use crate::footprint::stack::{Bound, Obstacle};
use crate::footprint::{Footprint, FootprintReport};

/// Obstacles that are named; the rest is counted.
const NAMED: usize = 3;

/// Sections, parts and bounds of each program.
pub fn footprint(report: &FootprintReport) -> String {
    report.programs.iter().map(program).collect::<Vec<_>>().join("\n")
}

fn program(program: &Footprint) -> String {
    let header = ["section", "address", "bytes", "memory"].map(str::to_owned).to_vec();
    let memory = |flash, ram| match (flash, ram) {
        (true, true) => "flash and RAM",
        (true, false) => "flash",
        (false, _) => "RAM",
    };
    let sections = program.sections.iter().map(|section| {
        let address = format!("{:#010x}", section.address);
        vec![section.name.clone(), address, section.bytes.to_string(), memory(section.flash, section.ram).to_owned()]
    });
    let sections = table(header, &[0, 3], sections);
    let header = ["code", "functions", "bytes"].map(str::to_owned).to_vec();
    let parts = program.code.iter();
    let parts = parts.map(|part| vec![part.part.clone(), part.functions.to_string(), part.bytes.to_string()]);
    let parts = table(header, &[0], parts);
    let bounds: String = program.stack.iter().map(bound).collect();
    let Footprint { file, flash_bytes, ram_bytes, .. } = program;
    format!("{file}: flash {flash_bytes} bytes, RAM {ram_bytes} bytes\n\n{sections}\n\n{parts}\n{bounds}")
}

fn bound(bound: &Bound) -> String {
    let Bound { root, functions, bytes, deepest, obstacles } = bound;
    if let Some(bytes) = bytes {
        let frames: String = deepest.iter().map(|frame| format!("{:8} {}\n", frame.bytes, frame.function)).collect();
        return format!("\nstack of {root}: at most {bytes} bytes ({functions} functions); deepest:\n{frames}");
    }
    let named: String = obstacles.iter().take(NAMED).map(|obstacle| format!("  {}\n", words(obstacle))).collect();
    let more = match obstacles.len().saturating_sub(NAMED) {
        0 => String::new(),
        more => format!("  and {more} more (all of them by --json)\n"),
    };
    format!("\nstack of {root}: not shown ({functions} functions)\n{named}{more}")
}

fn words(obstacle: &Obstacle) -> String {
    match obstacle {
        Obstacle::IndirectCalls { function, count } => format!("{count} indirect calls in {function}"),
        Obstacle::Recursion { function } => format!("{function} comes back to itself"),
        Obstacle::UnknownFrame { function } => {
            format!("size of the frame of {function}; build with RUSTFLAGS `-Z emit-stack-sizes`")
        }
        Obstacle::UnknownTarget { function, address } => {
            format!("{function} calls {address:#x}, where no function begins")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_shown_says_why() {
        let obstacle = |count| Obstacle::IndirectCalls { function: "core::fmt::write".into(), count };
        let obstacles = (1..=5).map(obstacle).collect();
        let text = bound(&Bound { root: "main".into(), functions: 9, bytes: None, deepest: Vec::new(), obstacles });
        assert!(text.contains("stack of main: not shown (9 functions)\n  1 indirect calls in core::fmt::write\n"));
        assert!(text.ends_with("and 2 more (all of them by --json)\n"), "{text}");
    }
}
