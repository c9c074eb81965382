//! The emulated boards: the product's own program gives every byte of every bundled frame.

use super::{bundled, frames};
use host_sim::hil::emulator::Board;
use std::io::Write;
use std::process::Command;

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
    let folder = bundled();
    let command = format!("host-sim hil @net.img --board {} --frames @frames --json", board.name());
    let (status, document) = folder.json(&command);
    assert_eq!(status, 0, "{document:#}");
    let summary = &document["summary"];
    assert_eq!((&summary["frames"], &summary["equal"], &summary["bytes_compared"]), (&3.into(), &3.into(), &96.into()));
    assert_eq!((&summary["link"]["lost"], &summary["link"]["overflowed"]), (&0.into(), &0.into()), "{summary}");
    assert_eq!((&summary["self_tests"], &document["unit"]), (&1.into(), &"instructions".into()));
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
