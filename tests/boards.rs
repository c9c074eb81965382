//! Every board computes the bytes of the known answer, which the host's f64 model gave, in every step.

use firmware::image::Image;
use model_compiler::emit::AlignedBytes;
use model_compiler::import::{ImportOptions, System, import};
use model_compiler::ir::Graph;
use model_compiler::passes::optimize;
use model_compiler::quantize::QuantizeOptions;
use tests::boards::{ALL, Run};
use tests::golden::{Lbc, Network};
use tests::{build, bundle};

/// A small network at its own resolution, which fits a microcontroller's RAM.
fn small(network: &Network) -> Graph {
    let options = ImportOptions { resolution: Some(network.resolution()), ..Default::default() };
    let mut graph = import("network", network.tensors(), &options).unwrap();
    optimize(&mut graph).unwrap();
    graph
}

fn steps(image: &[u8]) -> usize {
    Image::parse(&AlignedBytes::from(image)).unwrap().step_count().into()
}

/// Lines of steps: position, operator, instructions.
fn reported_steps(run: &Run) -> usize {
    run.console.lines().filter(|line| line.split_whitespace().next().is_some_and(|w| w.parse::<u16>().is_ok())).count()
}

#[test]
fn every_board_gives_the_known_answer_of_the_bundled_network() {
    let image = bundle::for_microcontroller().image;
    for board in ALL {
        let Some(run) = board.run(&image) else { continue };
        assert_eq!(run.status, Some(0), "{}:\n{}", board.name, run.console);
        assert!(run.console.ends_with("self-test passed\n"), "{}:\n{}", board.name, run.console);
        assert_eq!(reported_steps(&run), steps(&image), "{}:\n{}", board.name, run.console);
        println!("{}: {}", board.name, run.console.lines().rev().nth(1).unwrap_or_default().trim());
    }
}

#[test]
fn every_system_gives_its_known_answer_on_the_cortex_m4() {
    let others = System::ALL.into_iter().filter(|system| *system != System::Lbc);
    let mut graphs: Vec<(&str, Graph)> = others.map(|s| (s.name(), small(&Network::small(s)))).collect();
    graphs.extend([("lbc", false), ("lbc --hack", true)].map(|(name, hack)| (name, build::lbc(&Lbc::small(), hack))));
    for (name, graph) in graphs {
        let model = build::quantized(&graph, &QuantizeOptions::default());
        let image = build::compiled_for(&model, "cortex-m4").image;
        let Some(run) = ALL[0].run(&image) else { return };
        assert_eq!(run.status, Some(0), "{name}:\n{}", run.console);
        assert_eq!(reported_steps(&run), steps(&image), "{name}:\n{}", run.console);
    }
}

#[test]
fn a_changed_weight_is_noticed_on_the_board() {
    let mut image = bundle::for_microcontroller().image;
    let middle = image.len() / 2;
    image[middle] ^= 1;
    let Some(run) = ALL[0].run(&image) else { return };
    assert_eq!(run.status, Some(1), "{}", run.console);
    assert!(run.console.contains("constants section: damaged"), "{}", run.console);
}
