//! What is claimed of the firmware beside its answers: the same bytes on every instruction set, times that do not depend
//! on what the car sees.

use firmware::conformance::{self, WORKSPACE_BYTES};
use firmware::kernels::Portable;
use host_sim::buffers::GuardedArena;
use model_compiler::frames::{self, FrameFormat};
use model_compiler::integer_reference::{encode_input, to_bytes};
use model_compiler::pipeline::Compiled;
use tests::boards::ALL;
use tests::bundle;

/// Workspace and digest of a board's sweep.
fn swept(console: &str) -> (usize, &str) {
    let behind = |what| console.split(what).nth(1).unwrap_or_else(|| panic!("{console}"));
    let word = |text: &'static str| behind(text).split_whitespace().next().unwrap_or_default();
    (word("workspace of ").parse().unwrap_or_else(|e| panic!("{e}: {console}")), word("digest "))
}

#[test]
fn every_board_writes_the_bytes_of_the_host() {
    std::thread::scope(|scope| {
        for board in ALL {
            scope.spawn(move || {
                let Some(run) = board.check("conformance", &[0]) else { return };
                assert_eq!(run.status, Some(0), "{}: {}", board.name, run.console);
                let (bytes, digest) = swept(&run.console);
                assert!(bytes <= WORKSPACE_BYTES);
                let mut workspace = GuardedArena::new(bytes, 16);
                let summary = conformance::check(&Portable, 1, workspace.poisoned(0)).unwrap_or_else(|e| panic!("{e}"));
                assert_eq!(digest, format!("{:08x}", summary.digest), "{}", run.console);
                assert!(summary.cases > 16_000, "{summary:?}");
                print!("{}", run.console);
            });
        }
    });
}

/// The bundled network, and its evaluation frames as `measure` reads them.
fn network_and_frames() -> Vec<u8> {
    let Compiled { image, record, .. } = bundle::for_microcontroller();
    let model = &record.model;
    let frames = frames::load(&bundle::frames_path("evaluation"), &FrameFormat::of_model(model)).unwrap();
    let mut memory = image;
    memory.extend(b"FRAMES\0\0");
    memory.extend(u32::try_from(frames.len()).unwrap().to_le_bytes());
    for frame in &frames {
        for port in &model.inputs {
            let kind = port.kind.expect("a driving network's input");
            let raw: Vec<f64> = frame.raw(kind).unwrap().into_iter().map(f64::from).collect();
            memory.extend(to_bytes(&encode_input(kind, &raw), model.tensor(port.tensor).element));
        }
    }
    memory
}

#[test]
fn measured() {
    let memory = network_and_frames();
    for board in ALL {
        let Some(run) = board.check("measure", &memory) else { continue };
        assert_eq!(run.status, Some(0), "{}: {}", board.name, run.console);
        print!("{}", run.console);
    }
}
