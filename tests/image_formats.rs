//! An image in every form, read back by others than its writer: binutils' and LLVM's objcopy, a linker, rustc.

use firmware::image::Image;
use model_compiler::emit::AlignedBytes;
use model_compiler::import::System;
use object::{Object, ObjectSection, ObjectSymbol};
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Output};
use tests::commands::Folder;
use tests::golden::Network;

/// An address near the end of a 64 KiB page, so that the image crosses several.
const ADDRESS: u64 = 0x2100_FFF0;

/// A folder with `net.img` of a small network.
fn compiled() -> Folder {
    let folder = Folder::of(&Network::small(System::TransFuser));
    folder.ok("model-compiler compile @net.safetensors --calib @inputs.safetensors -o @net.img");
    let bytes = folder.read("net.img").len();
    assert!(bytes > (1 << 16) + 16, "{bytes} B reach into a third page of Intel HEX");
    folder
}

/// Runs a tool of others; `None` where it is missing, which is said past the test's capture.
fn tool(program: &str, package: &str, arguments: &[&str], folder: &Path) -> Option<Output> {
    match Command::new(program).args(arguments).current_dir(folder).output() {
        Ok(output) => Some(output),
        Err(_) => {
            let _ = writeln!(std::io::stderr(), "not run: no {program}; get it with Debian's package {package}");
            None
        }
    }
}

/// The bytes that objcopy finds in a file of hexadecimal records, from the lowest address on.
fn binary(program: &str, package: &str, format: &str, file: &str, folder: &Folder) -> Option<Vec<u8>> {
    let arguments = ["-I", format, "-O", "binary", file, "read.bin"];
    let output = tool(program, package, &arguments, folder.path(file).parent().unwrap())?;
    assert!(output.status.success(), "{program}: {}", String::from_utf8_lossy(&output.stderr));
    Some(folder.read("read.bin"))
}

#[test]
fn hexadecimal_records_hold_the_image_at_its_address() {
    let folder = compiled();
    let image = folder.read("net.img");
    for (format, name, lowest, end) in [
        ("hex", "ihex", ":020000042100D9\n:10FFF000", ":00000001FF\n"),
        ("srec", "srec", "\nS3252100FFF0", "\nS7052100FFF0EA\n"),
    ] {
        let written = folder
            .ok(&format!("model-compiler convert @net.img --format {format} --address {ADDRESS:#x} -o @net.{format}"));
        let text = String::from_utf8(folder.read(&format!("net.{format}"))).unwrap();
        assert_eq!(written, format!("@net.{format}: {} B\n", text.len()));
        assert!(text.contains(lowest) && text.ends_with(end), "{}", &text[..200]);
        for (program, package) in [("objcopy", "binutils"), ("llvm-objcopy", "llvm")] {
            // LLVM reads no S-records.
            if program == "objcopy" || format == "hex" {
                let Some(bytes) = binary(program, package, name, &format!("net.{format}"), &folder) else { continue };
                assert!(bytes == image, "{program} reads other bytes from {format}");
            }
        }
    }
}

#[test]
fn intel_hex_is_read_by_its_own_library_too() {
    let folder = compiled();
    folder.ok("model-compiler convert @net.img --format hex --address 0x2100fff0 -o @net.hex");
    let text = String::from_utf8(folder.read("net.hex")).unwrap();
    let (mut upper, mut next, mut bytes) = (0, ADDRESS, Vec::new());
    for record in ihex::Reader::new(&text) {
        match record.unwrap() {
            ihex::Record::ExtendedLinearAddress(half) => upper = u64::from(half) << 16,
            ihex::Record::Data { offset, value } => {
                assert_eq!(upper + u64::from(offset), next, "records follow each other");
                next += value.len() as u64;
                bytes.extend(value);
            }
            ihex::Record::EndOfFile => break,
            other => panic!("{other:?}"),
        }
    }
    assert!(bytes == folder.read("net.img"));
}

#[test]
fn the_object_has_the_image_in_its_section_between_its_symbols() {
    let folder = compiled();
    let image = folder.read("net.img");
    for (machine, architecture) in [
        ("arm", object::Architecture::Arm),
        ("aarch64", object::Architecture::Aarch64),
        ("x86-64", object::Architecture::X86_64),
    ] {
        folder.ok(&format!("model-compiler convert @net.img --format elf --machine {machine} -o @net.o"));
        let bytes = folder.read("net.o");
        let file = object::File::parse(bytes.as_slice()).unwrap();
        assert_eq!((file.architecture(), file.kind()), (architecture, object::ObjectKind::Relocatable));
        let section = file.section_by_name(".model").unwrap();
        assert!(section.data().unwrap() == image && section.align() == 16, "{machine}");
        let symbol = |name: &str| file.symbol_by_name(name).unwrap();
        let length = image.len() as u64;
        assert_eq!((symbol("model_start").address(), symbol("model_start").size()), (0, length));
        assert_eq!((symbol("model_end").address(), symbol("model_size").address()), (length, length));
        assert!(symbol("model_start").is_global());
    }
}

/// A program's memory, as cortex-m-rt has it in `memory.x`, and code that asks where the image is.
const MEMORY: &str = "MEMORY { FLASH (rx) : ORIGIN = 0x0, LENGTH = 64K }
INCLUDE model.x
SECTIONS { .text : { *(.text*) } > FLASH }
";
const PROGRAM: &str = ".global _start
.global where
.text
_start: nop
where: .word model_start, model_end, model_size
";

#[test]
fn a_linker_puts_the_image_where_the_script_says() {
    let folder = compiled();
    let image = folder.read("net.img");
    folder.write("memory.ld", MEMORY);
    folder.write("program.s", PROGRAM);
    let home = folder.path("");
    let package = "binutils-arm-none-eabi";
    let Some(assembled) = tool("arm-none-eabi-as", package, &["program.s", "-o", "program.o"], &home) else { return };
    assert!(assembled.status.success());
    for (format, linked) in [("elf", true), ("hex", false)] {
        folder.ok(&format!(
            "model-compiler convert @net.img --format {format} --address 0x21000000 --linker @model.x \
             -o @model.{format}"
        ));
        for (linker, package) in [("arm-none-eabi-ld", package), ("ld.lld", "lld")] {
            let mut arguments = vec!["-T", "memory.ld", "program.o", "-o", "program.elf"];
            arguments.extend(linked.then_some("model.elf"));
            let Some(output) = tool(linker, package, &arguments, &home) else { continue };
            assert!(output.status.success(), "{linker}: {}", String::from_utf8_lossy(&output.stderr));
            let bytes = folder.read("program.elf");
            let file = object::File::parse(bytes.as_slice()).unwrap();
            let text = file.section_by_name(".text").unwrap().data().unwrap();
            let (start, length) = (0x2100_0000_u32, image.len() as u32);
            let words: Vec<u8> = [start, start + length, length].into_iter().flat_map(u32::to_le_bytes).collect();
            assert!(text.ends_with(&words), "{linker}, {format}: {text:02x?}");
            let section = file.section_by_name(".model");
            assert_eq!(section.is_some(), linked, "{linker}, {format}");
            let holds = section.is_none_or(|s| s.address() == u64::from(start) && s.data().unwrap() == image);
            assert!(holds, "{linker}, {format}");
        }
    }
}

#[test]
fn rust_source_includes_the_image_beside_it() {
    let folder = compiled();
    folder.write("src/.keep", "");
    folder.ok("model-compiler convert @net.img --format rs -o @src/model.rs");
    assert!(folder.read("src/model.img") == folder.read("net.img"));
    let bytes = AlignedBytes::from(folder.read("net.img").as_slice());
    let image = Image::parse(&bytes).unwrap();
    let expected = format!(
        "// Written by model-compiler.\n\n/// Model image \"net\": {} B, {} steps, arena of {} B aligned to {}.\n\
         pub static MODEL: &[u8] = firmware::include_image!(\"model.img\");\n",
        bytes.len(),
        image.step_count(),
        image.arena_bytes(),
        image.arena_alignment()
    );
    assert_eq!(String::from_utf8(folder.read("src/model.rs")).unwrap(), expected);
}

#[test]
fn compile_writes_form_image_record_and_script_together() {
    let folder = compiled();
    folder.ok("model-compiler quantize @net.safetensors --calib @inputs.safetensors -o @net.qmodel");
    let printed =
        folder.ok("model-compiler compile @net.qmodel --format srec --address 0x21000000 --linker @new.x -o @new.srec");
    assert!(printed.ends_with(" written  @new.srec\n"), "{printed}");
    assert!(folder.read("new.img") == folder.read("net.img"));
    assert!(folder.read("new.record") == folder.read("net.record"));
    folder.ok("model-compiler convert @net.img --format srec --address 553648128 --linker @two.x -o @two.srec");
    assert!(folder.read("two.srec") == folder.read("new.srec") && folder.read("two.x") == folder.read("new.x"));
}

/// The command fails with this text, and no file appears.
#[track_caller]
fn refused(folder: &Folder, command: &str, expected: &str) {
    let names = folder.names();
    let outcome = folder.run(&format!("model-compiler {command}"));
    let expected = format!("error: {expected}\n");
    assert_eq!((outcome.status, outcome.out.as_str(), outcome.err.as_str()), (2, "", expected.as_str()), "{command}");
    assert_eq!(folder.names(), names, "{command}: files");
}

#[test]
fn options_that_cannot_be_met_are_refused() {
    let folder = compiled();
    let bytes = folder.read("net.img").len() as u64;
    let add = "add --address 0x… (where the image lies in the chip's memory, a multiple of 16)";
    let cases = [
        (
            "convert @net.img --format hex -o @new.hex",
            format!("--address: hex needs the address of the image\n  help: {add}"),
        ),
        (
            "convert @net.img --format srec --address 0xFFFFFFF0 -o @new.srec",
            format!(
                "--address: the image's {bytes} B at 0xfffffff0 end at {:#x}, behind 32-bit addresses\n  help: choose \
                 a lower address, or --format elf",
                0xFFFF_FFF0 + bytes
            ),
        ),
        (
            "convert @net.img --format hex --machine arm --address 0 -o @new.hex",
            "--machine: there is no architecture in a file of --format hex\n  help: leave it out, or add --format elf"
                .into(),
        ),
        (
            "convert @net.img --format rs --address 0 --linker @new.x -o @new.rs",
            "--linker: the image lies among the program's constants in a file of --format rs\n  help: leave it out, or \
             add --format elf"
                .into(),
        ),
        (
            "convert @net.img --format elf --address 0 -o @new.o",
            "--address: there is no address in a file of --format elf\n  help: leave it out, or add --linker FILE.x"
                .into(),
        ),
        (
            "convert @net.img -o @net.img",
            "@net.img: the output would replace the input\n  help: give it another name".into(),
        ),
        (
            "convert @net.img --format elf --address 0 --linker @new.o -o @new.o",
            "@new.o: two outputs have this name\n  help: give each another name".into(),
        ),
        (
            "compile @net.safetensors --calib @inputs.safetensors --format elf -o @new.img",
            "@new.img: this name is for the image itself\n  help: give the output another extension, such as .elf"
                .into(),
        ),
        (
            "convert @net.safetensors --format elf -o @new.o",
            "@net.safetensors: header byte 0: this is not a model image: found".into(),
        ),
    ];
    for (command, message) in cases {
        if message.ends_with("found") {
            let outcome = folder.run(&format!("model-compiler {command}"));
            assert!(outcome.status == 2 && outcome.err.contains(&message), "{}", outcome.err);
        } else {
            refused(&folder, command, &message);
        }
    }
}

#[test]
fn addresses_that_are_none_are_usage_errors() {
    let folder = compiled();
    for (address, message) in [
        ("0x8", "found 0x8, expected a multiple of 16"),
        ("flash", "found \"flash\", expected an address such as 0x21000000"),
    ] {
        let outcome =
            folder.run(&format!("model-compiler convert @net.img --format hex --address {address} -o @new.hex"));
        assert!(outcome.status == 2 && outcome.err.contains(message), "{}", outcome.err);
    }
}

#[test]
fn inspect_says_what_a_form_is() {
    let folder = compiled();
    for (format, form) in [("hex", "Intel HEX"), ("srec", "a file of S-records"), ("elf", "an ELF file")] {
        let address = if format == "elf" { "" } else { " --address 0x21000000" };
        folder.ok(&format!("model-compiler convert @net.img --format {format}{address} -o @new.{format}"));
        let message =
            format!("@new.{format}: this is {form}, a form of an image\n  help: inspect the .img that it was made of");
        refused(&folder, &format!("inspect @new.{format}"), &message);
    }
}
