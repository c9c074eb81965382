//! The `bench` command.

use super::Common;
use crate::backends::{Backend, BackendKind};
use crate::bench;
use crate::report::{json, terminal};
use clap::Args;
use indicatif::ProgressBar;
use model_compiler::cli::Console;
use model_compiler::error::Result;
use std::collections::BTreeSet;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(super) struct BenchArgs {
    /// Model image.
    #[arg(value_name = "OUT.img")]
    image: PathBuf,
    /// Kernels to measure; may be repeated [default: all of this machine].
    #[arg(long = "backend", value_name = "NAME")]
    backends: Vec<BackendKind>,
    /// Inferences per backend, and as many again for the steps [default: as many as fit into ten seconds, at least 5].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    rounds: Option<u32>,
    /// Show the K slowest steps of the fastest backend.
    #[arg(long, value_name = "K", default_value_t = 15)]
    top: usize,
    /// Show every step, in the order of execution.
    #[arg(long, conflicts_with = "top")]
    all: bool,
}

impl BenchArgs {
    pub(super) fn execute(self, common: &Common, console: &mut Console<'_>, progress: &ProgressBar) -> Result<u8> {
        let (backends, top) = (self.choose()?, self.top());
        let options = bench::Options { image: self.image, backends, rounds: self.rounds };
        let report = bench::bench(&options, progress)?;
        if let Some(reason) = &report.unnamed {
            console.complain(&format!("warning: steps bear the names of their operators: {reason}"));
        }
        let table = || terminal::bench(&report, top);
        console.print(&if common.json { json::bench(&report).to_string() } else { table() });
        Ok(0)
    }

    /// Each backend once, the portable one first.
    fn choose(&self) -> Result<Vec<Backend>> {
        if self.backends.is_empty() {
            return Ok(Backend::all());
        }
        let kinds: BTreeSet<BackendKind> = self.backends.iter().copied().collect();
        kinds.into_iter().map(|kind| Backend::choose(Some(kind))).collect()
    }

    fn top(&self) -> Option<usize> {
        (!self.all).then_some(self.top)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::Command;
    use crate::cli::tests::parse;

    #[test]
    fn bench_takes_each_backend_once() {
        let choose = |arguments: &str| {
            let cli = parse(&format!("host-sim bench a.img{arguments}")).unwrap();
            let Some(Command::Bench { bench, .. }) = cli.command else { panic!("not bench") };
            let kinds: Vec<BackendKind> = bench.choose().unwrap().into_iter().map(Backend::kind).collect();
            (kinds, bench.top())
        };
        assert_eq!(choose(" --backend portable --backend portable --all"), (vec![BackendKind::Portable], None));
        let every: Vec<BackendKind> = Backend::all().into_iter().map(Backend::kind).collect();
        assert_eq!(choose(""), (every, Some(15)));
        assert!(parse("host-sim bench a.img --top 3 --all").is_err());
        assert!(parse("host-sim bench a.img --rounds 0").is_err());
    }
}
