//! The C interface: its header, a program in C on this machine, and one on an emulated Cortex-M4.

use firmware::engine::Engine;
use firmware::image::Image;
use firmware::kernels::Portable;
use firmware::tensor::ElementType;
use model_compiler::emit::AlignedBytes;
use model_compiler::import::System;
use model_compiler::quantize::QuantizeOptions;
use object::{Object, ObjectSymbol};
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;
use tests::boards::{ALL, Program, Run};
use tests::golden::Network;
use tests::{build, c_header};

/// A small TransFuser for a microcontroller.
fn image() -> Vec<u8> {
    let graph = build::small(&Network::small(System::TransFuser));
    build::compiled_for(&build::quantized(&graph, &QuantizeOptions::default()), "cortex-m4").image
}

/// The waypoints of an image over inputs that are zero everywhere, as the programs print them.
fn waypoints(image: &[u8]) -> Vec<String> {
    let bytes = AlignedBytes::from(image);
    let image = Image::parse(&bytes).unwrap();
    let mut arena = AlignedBytes::zeroed(image.arena_bytes() as usize);
    let mut engine = Engine::new(image, Portable, &mut arena).unwrap();
    for input in 0..image.input_count() {
        let port = image.input(input).unwrap();
        let is_i8 = image.tensor(port.tensor).unwrap().element == ElementType::I8;
        engine.input_mut(input.into()).unwrap().fill(if is_i8 { port.zero_point as u8 } else { 0 });
    }
    engine.begin();
    while engine.step().unwrap() != firmware::engine::Progress::Done {}
    let line = |w: &firmware::waypoint::Waypoint| {
        format!("waypoint, 1/65536 m: right {}, forward {}", w.right.to_bits(), w.forward.to_bits())
    };
    engine.waypoints(0).unwrap().iter().map(line).collect()
}

#[test]
fn the_stored_header_is_what_the_sources_give() {
    let stored = fs::read_to_string(c_header::path()).unwrap();
    assert!(stored == c_header::generate(), "write it anew: cargo run -p tests --example make_c_header");
}

/// The interface as a library for this machine, which cargo builds with the examples; `None` where it or a C compiler
/// is missing, which is said past the test's capture.
fn host_program(folder: &Path) -> Option<PathBuf> {
    let library = std::env::current_exe().unwrap().parent().unwrap().join("../examples/libc_library.a");
    let compiler = Command::new("cc").arg("--version").output().is_ok_and(|output| output.status.success());
    if !library.exists() || !compiler {
        let _ = writeln!(
            std::io::stderr(),
            "not run: the C interface on this machine; it needs {} (cargo build -p tests --example c_library) and the \
             C compiler cc (Debian's package gcc)",
            library.display()
        );
        return None;
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let program = folder.join("api");
    let output = Command::new("cc")
        .args(["-std=c11", "-O1", "-Wall", "-Wextra", "-Werror", "-I"])
        .arg(root.join("firmware/include"))
        .arg(root.join("tests/c/api.c"))
        .arg(&library)
        .args(["-lpthread", "-ldl", "-lm", "-o"])
        .arg(&program)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(program)
}

#[test]
fn a_program_in_c_runs_a_model_on_this_machine() {
    let folder = tempfile::tempdir().unwrap();
    let Some(program) = host_program(folder.path()) else { return };
    let image = image();
    let file = folder.path().join("model.img");
    fs::write(&file, &image).unwrap();
    let output = Command::new(program).arg(file).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(
        (output.status.code(), text.lines().collect::<Vec<_>>()),
        (Some(0), waypoints(&image).iter().map(String::as_str).collect())
    );
}

#[test]
fn a_program_in_c_runs_a_model_on_the_cortex_m4() {
    let mut image = image();
    let Some(Run { status, console }) = ALL[0].run_program(Program::InC, "", &image) else { return };
    let lines: Vec<&str> = console.lines().collect();
    assert_eq!(status, Some(0), "{console}");
    let parsed = AlignedBytes::from(image.as_slice());
    let parsed = Image::parse(&parsed).unwrap();
    let facts = [
        format!("firmware {}, model {}", env!("CARGO_PKG_VERSION"), parsed.name()),
        format!("image bytes {}", image.len()),
        format!("arena bytes {}", parsed.arena_bytes()),
        format!("steps {}", parsed.step_count()),
        "self-test passed".into(),
    ];
    assert_eq!(lines, [&facts[..], &waypoints(&image)].concat());
    let middle = image.len() / 2;
    image[middle] ^= 1;
    let Some(Run { status, console }) = ALL[0].run_program(Program::InC, "", &image) else { return };
    let expected = "error: image: a section of the image does not agree with its CRC\n";
    assert_eq!((status, console.as_str()), (Some(1), expected));
}

#[test]
fn no_panic_is_linked_into_a_program_in_c() {
    let Some(program) = ALL[0].built_program(Program::InC) else { return };
    let bytes = fs::read(&program).unwrap();
    let file = object::File::parse(&*bytes).unwrap();
    let names: Vec<&str> = file.symbols().filter_map(|symbol| symbol.name().ok()).collect();
    assert!(names.contains(&"fw_step"), "{} has its symbols", program.display());
    let panics: Vec<_> = names.iter().filter(|name| name.contains("panic")).collect();
    assert!(panics.is_empty(), "{panics:?}");
}
