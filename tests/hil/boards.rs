//! The emulated boards: the product's own program gives every byte of every bundled frame.

use super::{bundled, frames, recorded};
use host_sim::hil::emulator::Board;
use model_compiler::import::System;
use std::io::Write;
use std::process::Command;
use tests::commands::Folder;
use tests::golden::Network;

/// Whether program and emulator are there, which is said past the test's capture where they are not.
fn is_there(board: Board) -> bool {
    let runs = Command::new(board.emulator()).arg("--version").output().is_ok_and(|output| output.status.success());
    let is_there = runs && board.program().is_file();
    if !is_there {
        let _ = writeln!(
            std::io::stderr(),
            "not run: hil on {}; tests/run builds {} and installs {} (Debian's package qemu-system-arm)",
            board.name(),
            board.program().display(),
            board.emulator()
        );
    }
    is_there
}

fn assert_gives_every_byte(board: Board) {
    if !is_there(board) {
        return;
    }
    let folder = bundled(board.target());
    let command = format!("host-sim hil @net.img --board {} --frames @frames --json", board.name());
    let (status, document) = folder.json(&command);
    assert_eq!(status, 0, "{document:#}");
    let summary = &document["summary"];
    assert_eq!((&summary["frames"], &summary["equal"], &summary["bytes_compared"]), (&3.into(), &3.into(), &96.into()));
    assert_eq!((&summary["link"]["lost"], &summary["link"]["overflowed"]), (&0.into(), &0.into()), "{summary}");
    // The one that was asked for; a board that waits tests itself, too.
    assert!(summary["self_tests"].as_u64() >= Some(1), "{summary}");
    assert_eq!(document["unit"], "instructions");
    assert_eq!(frames(&document).len(), 3);
    println!("{}: {summary}", board.name());
}

#[test]
fn the_cortex_m4_gives_every_byte() {
    assert_gives_every_byte(Board::An386);
}

#[test]
fn the_cortex_m7_gives_every_byte() {
    assert_gives_every_byte(Board::An500);
}

#[test]
fn the_cortex_m55_gives_every_byte() {
    assert_gives_every_byte(Board::An547);
}

#[test]
fn the_cortex_a_gives_every_byte() {
    assert_gives_every_byte(Board::Virt);
}

/// Both ways to restart: a Cortex-M's own, and the firmware's of a Cortex-A.
#[test]
fn a_new_image_is_installed_started_and_confirmed() {
    for (board, other) in [(Board::An386, Board::Virt), (Board::Virt, Board::An386)] {
        let [target, foreign] = [board, other].map(Board::target);
        if !is_there(board) {
            continue;
        }
        let folder = Folder::of(&Network::small(System::TransFuser));
        for (name, options) in [
            ("old", format!("{target} --revision 5")),
            ("new", format!("{target} --revision 6")),
            ("older", format!("{target} --revision 4")),
            ("foreign", format!("{foreign} --revision 6")),
        ] {
            let command = "model-compiler compile @net.safetensors --calib @inputs.safetensors --target";
            folder.ok(&format!("{command} {options} -o @{name}.img"));
        }
        let update = |image: &str| format!("host-sim update @{image}.img --board {} --running @old.img", board.name());
        let (status, document) = folder.json(&format!("{} --json", update("new")));
        assert_eq!(status, 0, "{document:#}");
        let revisions = ["before", "after"].map(|when| document[when]["revision"].as_u64());
        assert_eq!((revisions, &document["board"]), ([Some(5), Some(6)], &board.name().into()));
        assert_eq!(document["after"]["target"], target);
        for (image, reason) in [
            ("older", "image of revision 4 is older than the running 5"),
            ("foreign", "image compiled for target"),
            ("old", "this image runs already"),
        ] {
            let outcome = folder.run(&update(image));
            assert_eq!(outcome.status, 2, "{outcome:?}");
            assert!(outcome.err.contains(reason), "{outcome:?}");
        }
        // What is for another board is not run here.
        let outcome =
            folder.run(&format!("host-sim hil @foreign.img --board {} --inputs @inputs.safetensors", board.name()));
        assert_eq!(outcome.status, 2, "{outcome:?}");
        assert!(outcome.err.contains("or not for this board"), "{outcome:?}");
    }
}

#[test]
fn a_log_is_driven_on_the_cortex_m4_as_on_the_host() {
    if !is_there(Board::An386) {
        return;
    }
    let folder = recorded(System::TransFuser, 8);
    let (status, document) = folder.json("host-sim hil @net.img --board an386 --log @log --steps --json");
    assert_eq!(status, 0, "{document:#}");
    assert_eq!(document["summary"]["equal"], 8, "{document:#}");
}
