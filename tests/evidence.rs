//! What is claimed of the firmware beside its answers: the same bytes on every instruction set, times that do not depend
//! on what the car sees, a bound of the stack, no float operation in inference.

use firmware::conformance::{self, WORKSPACE_BYTES};
use firmware::kernels::Portable;
use host_sim::footprint::stack::{Bound, Obstacle};
use host_sim::footprint::{self, Footprint};
use model_compiler::frames::{self, FrameFormat};
use model_compiler::integer_reference::{encode_input, to_bytes};
use model_compiler::pipeline::Compiled;
use object::{Object as _, ObjectSymbol as _};
use std::io::Write as _;
use std::path::Path;
use tests::boards::{ALL, Board, Program};
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
                let mut workspace = vec![0; bytes];
                let summary = conformance::check(&Portable, 1, &mut workspace).unwrap_or_else(|e| panic!("{e}"));
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

/// A step that took more instructions over some inputs than over others.
#[derive(Debug, PartialEq, Eq)]
struct Dependent {
    position: usize,
    name: String,
    spread: u64,
}

/// Steps of a measurement whose instructions differ by more than `resolution`, and how many steps there are.
fn dependent_steps(console: &str, resolution: u64) -> (usize, Vec<Dependent>) {
    let step = |line: &str| {
        let [position, name, _, _, spread] = line.split_whitespace().collect::<Vec<_>>().try_into().ok()?;
        Some(Dependent { position: position.parse().ok()?, name: name.to_owned(), spread: spread.parse().ok()? })
    };
    let steps: Vec<Dependent> = console.lines().filter_map(step).collect();
    (steps.len(), steps.into_iter().filter(|step| step.spread > resolution).collect())
}

#[test]
fn a_step_that_depends_on_its_inputs_is_found() {
    let console =
        "an386: image x, 9 runs\nstep operator\n   0 conv2d 10 11 1\n   1 softmax 10 12 2\n network 20 23 3\n";
    let found = Dependent { position: 1, name: "softmax".into(), spread: 2 };
    assert_eq!(dependent_steps(console, 1), (2, vec![found]));
}

/// Bytes of stack that a measurement saw under a function.
fn seen_stack(console: &str, what: &str) -> u64 {
    let line = console.lines().find(|line| line.starts_with("stack: ")).unwrap_or_else(|| panic!("{console}"));
    let mut words = line.split([' ', ',']).skip_while(|word| *word != what).skip(1);
    words.next().and_then(|bytes| bytes.parse().ok()).unwrap_or_else(|| panic!("{console}"))
}

/// Whether all that is missing is the compiler's note of the frames.
fn lacks_frames(bound: &Bound) -> bool {
    bound.obstacles.iter().all(|obstacle| matches!(obstacle, Obstacle::UnknownFrame { .. }))
}

fn assert_stack_is_bounded(board: &Board, console: &str) {
    let functions = ["parse", "check", "step"];
    let roots = functions.map(|function| format!("measure::{function}"));
    let program = footprint::measure(&board.program(Program::Check), &roots).unwrap_or_else(|e| panic!("{e}"));
    for (function, bound) in functions.into_iter().zip(program.stack) {
        let seen = seen_stack(console, function);
        match bound.bytes {
            Some(bytes) => {
                println!("{}: stack of {function}: {seen} bytes seen, at most {bytes}", board.name);
                assert!((seen..2 * seen.max(256)).contains(&bytes), "{}: {function}: {seen} {bound:?}", board.name);
            }
            None if lacks_frames(&bound) => println!("{}: not run: no frames are noted", board.name),
            None => panic!("{}: {bound:?}", board.name),
        }
    }
}

#[test]
fn time_is_the_same_for_every_input_and_the_stack_has_a_bound() {
    let memory = network_and_frames();
    std::thread::scope(|scope| {
        for board in ALL {
            let memory = &memory;
            scope.spawn(move || {
                let Some(run) = board.check("measure", memory) else { return };
                assert_eq!(run.status, Some(0), "{}: {}", board.name, run.console);
                assert!(run.console.contains("9 runs, 3 of them over frames"), "{}", run.console);
                let (steps, dependent) = dependent_steps(&run.console, board.counter_resolution);
                assert!(steps > 100 && dependent.is_empty(), "{}: {dependent:?}\n{}", board.name, run.console);
                assert_stack_is_bounded(&board, &run.console);
            });
        }
    });
}

#[test]
fn products_hold_no_checks_and_fit_their_flash() {
    for board in ALL {
        let [drive, check] = [Program::Drive, Program::Check].map(|program| board.program(program));
        if !drive.exists() {
            continue;
        }
        let [drive, check] = [drive, check].map(|elf| footprint::measure(&elf, &[]).unwrap_or_else(|e| panic!("{e}")));
        let has = |footprint: &Footprint, part: &str| footprint.code.iter().any(|size| size.part == part);
        assert!(has(&check, "firmware::conformance") && !has(&drive, "firmware::conformance"), "{drive:?}");
        let code: u64 = drive.code.iter().map(|part| part.bytes).sum();
        let text: u64 = drive.sections.iter().filter(|s| s.name == ".text").map(|s| s.bytes).sum();
        assert!(code <= text && 10 * code > 9 * text, "{}: functions {code} of {text} bytes", board.name);
        assert!(drive.flash_bytes < 320 << 10, "{}: {drive:?}", board.name);
        println!("{}: flash {} bytes, RAM {} bytes", board.name, drive.flash_bytes, drive.ram_bytes);
    }
}

/// Calls of float routines of the compiler's library (names of the Arm run-time ABI and of libgcc) in a proof for a
/// machine without floating point; `None` where it is not built, which is said.
fn float_calls(program: &str) -> Option<Vec<String>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/mcu/riscv32imac-unknown-none-elf/release");
    let Ok(bytes) = std::fs::read(folder.join(program)) else {
        let _ = writeln!(std::io::stderr(), "not run: {program}; tests/run builds it");
        return None;
    };
    let elf = object::File::parse(&*bytes).unwrap_or_else(|e| panic!("{program}: {e}"));
    let names: Vec<String> = elf.symbols().filter_map(|symbol| symbol.name().ok().map(str::to_owned)).collect();
    assert!(names.iter().any(|name| name == "start"), "{program} has symbols");
    let is_float = |name: &String| {
        let library = name.strip_prefix("__").unwrap_or_default();
        ["aeabi_f", "aeabi_d"].iter().any(|prefix| library.starts_with(prefix))
            || ["sf", "df"].iter().any(|kind| library.contains(kind))
    };
    Some(names.into_iter().filter(is_float).collect())
}

#[test]
fn inference_has_no_float_operation() {
    let Some(found) = float_calls("inference") else { return };
    assert_eq!(found, Vec::<String>::new());
    assert_eq!(float_calls("inference-float"), Some(vec!["__mulsf3".to_owned()]), "the twin's operation is found");
}
