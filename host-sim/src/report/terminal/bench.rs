//! Latency: the whole, the operators and the slowest steps, a group of columns per backend.

use super::{figure, table};
use crate::bench::figures::{BenchReport, Distribution, OperatorTotal, Rate, Share, StepTime, Whole};
use std::cmp::Ordering;
use std::fmt::Write;

/// The whole, the operators, and the `top` slowest steps (`None`: all of them, in the order of execution).
pub fn bench(report: &BenchReport, top: Option<usize>) -> String {
    let name = &report.model.name;
    let mut text = format!("{name} (sha256 {}…), {}\n\n", &report.model.sha256[..16], rounds(report.rounds));
    let _ = writeln!(text, "{}\n", wholes(&report.backends));
    let _ = writeln!(text, "{}\n", operators(report));
    let _ = writeln!(text, "{}\n", steps(report, top));
    text + &memory(report)
}

fn rounds(rounds: u32) -> String {
    if rounds == 1 { "1 round".to_owned() } else { format!("{rounds} rounds") }
}

fn wholes(backends: &[Whole]) -> String {
    let header = ["whole", "clock", "median ms", "min ms", "10 % ms", "90 % ms", "GMAC/s", "× portable"];
    let line = |backend: &str, clock: &str, times: &Distribution, rate: Option<Rate>| {
        let rate = rate.map_or(["", ""].map(str::to_owned), rate_cells);
        let times = [times.median, times.min, times.p10, times.p90].map(milliseconds);
        [backend.to_owned(), clock.to_owned()].into_iter().chain(times).chain(rate).collect::<Vec<_>>()
    };
    let rows = backends.iter().flat_map(|whole| {
        let cpu = whole.cpu_ms.map(|times| line(whole.backend, "CPU", &times, Some(whole.rate)));
        let (name, rate) = if cpu.is_some() { ("", None) } else { (whole.backend, Some(whole.rate)) };
        cpu.into_iter().chain([line(name, "wall", &whole.wall_ms, rate)])
    });
    table(header.map(str::to_owned).to_vec(), &[0, 1], rows)
}

fn operators(report: &BenchReport) -> String {
    let mut operators: Vec<&OperatorTotal> = report.operators.iter().collect();
    operators.sort_by(|a, b| slower(&a.times, &b.times));
    let header = header(&["operator", "steps", "MACs"], report);
    let rows = operators.into_iter().map(|total| {
        let cells = [total.op.to_owned(), total.steps.to_string(), macs(total.macs)];
        cells.into_iter().chain(share_cells(&total.times)).collect()
    });
    table(header, &[0], rows)
}

fn steps(report: &BenchReport, top: Option<usize>) -> String {
    let mut steps: Vec<&StepTime> = report.steps.iter().collect();
    if let Some(top) = top {
        steps.sort_by(|a, b| slower(&a.times, &b.times));
        steps.truncate(top);
    }
    let rows = steps.iter().map(|step| {
        let [height, width, channels] = step.shape;
        let shape = format!("{height}×{width}×{channels}");
        let cells = [step.position.to_string(), step.step.clone(), step.op.to_owned(), shape, macs(step.macs)];
        cells.into_iter().chain(share_cells(&step.times)).collect()
    });
    let table = table(header(&["", "step", "op", "shape", "MACs"], report), &[1, 2, 3], rows);
    match report.steps.len() - steps.len() {
        0 => table,
        hidden => format!("{table}\n… and {hidden} faster steps (--all shows them)"),
    }
}

/// Slowest first, by the backend in the last columns: the fastest one, whose slow steps are worth a look.
fn slower(a: &[Share], b: &[Share]) -> Ordering {
    let ms = |times: &[Share]| times.last().map_or(0.0, |share| share.ms);
    ms(b).total_cmp(&ms(a))
}

fn header(first: &[&str], report: &BenchReport) -> Vec<String> {
    let group = |whole: &Whole| {
        let columns = [format!("{} ms", whole.backend), "%".to_owned(), "GMAC/s".to_owned()];
        columns.into_iter().chain(is_compared(&whole.rate, whole.backend).then(|| "×".to_owned()))
    };
    first.iter().map(|name| (*name).to_owned()).chain(report.backends.iter().flat_map(group)).collect()
}

fn share_cells(times: &[Share]) -> Vec<String> {
    let cells = |share: &Share| {
        let [speed, speedup] = rate_cells(share.rate);
        let cells = [milliseconds(share.ms), format!("{:.1}", 100.0 * share.share), speed];
        cells.into_iter().chain(is_compared(&share.rate, share.backend).then_some(speedup)).collect::<Vec<_>>()
    };
    times.iter().flat_map(cells).collect()
}

/// Whether a backend has a column for its ratio to the portable kernels, which themselves need none.
fn is_compared(rate: &Rate, backend: &str) -> bool {
    rate.speedup.is_some() && backend != "portable"
}

fn rate_cells(rate: Rate) -> [String; 2] {
    [figure(rate.gmacs_per_s, 2), figure(rate.speedup, 2)]
}

fn macs(macs: Option<u64>) -> String {
    macs.map_or("–".to_owned(), |macs| macs.to_string())
}

fn milliseconds(ms: f64) -> String {
    format!("{ms:.3}")
}

fn memory(report: &BenchReport) -> String {
    let (image, arena) = (report.image_bytes, report.arena_bytes);
    let mut text = format!(
        "{:22} {}\n{:22} {image} B image + {arena} B arena = {} B\n",
        "multiply-accumulates",
        report.macs,
        "network",
        image + arena
    );
    if let Some(peak) = report.peak_memory_bytes {
        let _ = writeln!(text, "{:22} {peak} B at most, the program included", "process");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::figures::shares;
    use crate::run::ModelInfo;

    fn report() -> BenchReport {
        let times = |portable: f64, avx2: f64, macs| {
            shares(&["portable", "avx2"], &[portable, avx2], &[10.0, 4.0], macs, Some(0))
        };
        let step = |position, step: &str, op, macs, times| StepTime {
            position,
            step: step.into(),
            op,
            shape: [8, 8, 64],
            macs,
            times,
        };
        let total = |op, macs, times| OperatorTotal { op, steps: 1, macs, times };
        let even = |ms| Distribution { median: ms, min: ms, p10: ms, p90: ms };
        let whole = |backend, ms, wall| Whole {
            backend,
            cpu_ms: Some(even(ms)),
            wall_ms: even(wall),
            rate: Rate::new(ms, Some(8_000_000), Some(10.0)),
        };
        BenchReport {
            schema: 1,
            model: ModelInfo { name: "mini".into(), sha256: "ab".repeat(32) },
            rounds: 7,
            image_bytes: 4096,
            arena_bytes: 1024,
            peak_memory_bytes: Some(999_424),
            macs: 8_000_000,
            backends: vec![whole("portable", 10.0, 11.0), whole("avx2", 4.0, 5.0)],
            operators: vec![
                total("add", None, times(2.0, 3.0, None)),
                total("conv2d", Some(8_000_000), times(8.0, 1.0, Some(8_000_000))),
            ],
            steps: vec![
                step(0, "畳み込み", "conv2d", Some(8_000_000), times(8.0, 1.0, Some(8_000_000))),
                step(1, "sum", "add", None, times(2.0, 3.0, None)),
            ],
            unnamed: None,
        }
    }

    fn words(line: &str) -> Vec<&str> {
        line.split_whitespace().collect()
    }

    #[test]
    fn the_slowest_step_of_the_fastest_backend_comes_first() {
        let text = bench(&report(), Some(1));
        assert!(text.starts_with("mini (sha256 abababababababab…), 7 rounds\n"), "{text}");
        let lines: Vec<Vec<&str>> = text.lines().map(words).collect();
        let at = |first: &[&str]| lines.iter().position(|line| line.starts_with(first)).expect("the line");
        assert_eq!(lines[at(&["avx2", "CPU"])][2..], ["4.000", "4.000", "4.000", "4.000", "2.00", "2.50"]);
        assert_eq!(lines[at(&["avx2", "CPU"]) + 1], ["wall", "5.000", "5.000", "5.000", "5.000"]);
        let add = ["add", "1", "–", "2.000", "20.0", "–", "3.000", "75.0", "–", "0.67"];
        assert_eq!(lines[at(&["operator"]) + 1], add);
        assert_eq!(lines[at(&["step", "op"]) + 1][..4], ["1", "sum", "add", "8×8×64"]);
        assert_eq!(lines[at(&["step", "op"]) + 2], words("… and 1 faster steps (--all shows them)"));
        assert_eq!(lines[at(&["network"])], words("network 4096 B image + 1024 B arena = 5120 B"));
    }

    #[test]
    fn all_steps_come_in_the_order_of_execution_and_wide_characters_align() {
        let text = bench(&report(), None);
        assert!(!text.contains("faster steps"), "{text}");
        let first = text.lines().position(|line| words(line).starts_with(&["step", "op"])).expect("the table");
        let rows: Vec<&str> = text.lines().skip(first + 1).take(2).collect();
        assert_eq!((words(rows[0])[1], words(rows[1])[1]), ("畳み込み", "sum"));
        // Four characters of two columns each.
        let column = |row: &str| row.chars().take_while(|c| *c != '×').count();
        assert_eq!(column(rows[0]) + 4, column(rows[1]), "{text}");
    }

    #[test]
    fn a_system_with_one_clock_has_one_line_per_backend() {
        let mut report = report();
        report.backends.iter_mut().for_each(|whole| whole.cpu_ms = None);
        report.peak_memory_bytes = None;
        let text = bench(&report, None);
        assert!(!text.contains("CPU") && !text.contains("process"), "{text}");
        assert!(text.lines().any(|line| words(line).starts_with(&["avx2", "wall", "5.000"])), "{text}");
    }
}
