//! The form to look at: one page that holds everything it shows, readable without scripts, color or network.
//!
//! A section per file, each from plain data to markup; one that does not apply to a network is absent. Text from files
//! is escaped by the template. Every plot has its figures in a table below it.

use super::VerifyReport;
use crate::attention::AttentionReport;
use crate::diff::Diff;
use crate::drive::DriveReport;
use crate::gates::GateOutcome;
use maud::{DOCTYPE, Markup, PreEscaped, html};
use model_compiler::frames::Frame;

mod attention;
mod changes;
mod channels;
mod classes;
mod controls;
mod drive;
mod frames;
mod gates;
mod graph;
mod histogram;
mod maps;
mod memory;
mod noise;
mod plot;
mod points;
mod steps;
mod summary;
mod tensors;
mod waypoints;

const STYLE: &str = include_str!("html/style.css");
/// Sorts tables and picks a tensor; without it tables stand in the order of the program and all tensors in a list.
const SCRIPT: &str = include_str!("html/script.js");

/// The page of a verification. `frames` are its frames, in order; cameras and LiDAR histograms are drawn from them.
pub fn page(report: &VerifyReport, frames: &[Frame]) -> String {
    let title = format!("{} for {}", report.model.name, report.target);
    let body = html! {
        (summary::section(report))
        @if let Some(baseline) = &report.baseline { (changes::section(baseline)) }
        (gates::section(&report.gates))
        (graph::section(&report.steps))
        @if let Some(shares) = &report.noise { (noise::section(shares)) }
        (tensors::section(&report.steps))
        (channels::section(&report.steps))
        (memory::section(&report.memory, &report.summary))
        (waypoints::section(&report.frames, frames))
        (controls::section(&report.frames))
        (points::section(&report.frames, frames))
        (classes::section(report.summary.accuracy.as_ref(), &report.frames))
        (frames::section(&report.frames))
        (steps::section(&report.steps))
    };
    shell(&title, &body)
}

/// The page of a comparison of two reports.
pub fn diff_page(diff: &Diff, gates: &[GateOutcome]) -> String {
    let body = html! {
        header {
            p.kicker { "Two verification reports" }
            h1 { (diff.before.name) " → " (diff.after.name) }
        }
        (changes::section(diff))
        (gates::section(gates))
    };
    shell(&format!("{} → {}", diff.before.name, diff.after.name), &body)
}

/// The page of attention statistics. `frames` are its frames, in order.
pub fn attention_page(report: &AttentionReport, frames: &[Frame]) -> String {
    let body = html! {
        (attention::summary(report))
        (gates::section(&report.gates))
        (attention::statistics(report))
        (attention::cells(report, frames))
        (attention::frames(report))
    };
    shell(&format!("Attention at {}", report.block), &body)
}

/// The page of a replayed log.
pub fn drive_page(report: &DriveReport) -> String {
    let body = html! {
        (drive::summary(report))
        (drive::controls(report))
    };
    shell(&format!("{} drives", report.model.name), &body)
}

fn shell(title: &str, body: &Markup) -> String {
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                main { (body) }
                script { (PreEscaped(SCRIPT)) }
            }
        }
    };
    page.into_string()
}

/// A section with its title and what it shows in a sentence or two.
fn section(id: &str, title: &str, about: &Markup, content: &Markup) -> Markup {
    html! {
        section id=(id) {
            h2 { (title) }
            p.about { (about) }
            (content)
        }
    }
}

/// The figures of a plot, folded away.
fn data(what: &str, table: &Markup) -> Markup {
    html! {
        details.data {
            summary { (what) }
            (table)
        }
    }
}

/// A text that may be broken behind the dots of a name, but not behind those of a figure.
fn name(text: &str) -> Markup {
    let is_name = text.starts_with(|c: char| c.is_alphabetic());
    html! {
        @if is_name {
            @for part in text.split_inclusive('.') { (part) @if part.ends_with('.') { wbr; } }
        } @else { (text) }
    }
}

/// A table that scrolls by itself where the page is narrow. The first `words` columns are text, the others figures.
fn table(header: &[&str], words: usize, rows: &[Vec<String>]) -> Markup {
    let class = |column: usize| if column < words { "w" } else { "n" };
    html! {
        div.scroll {
            table {
                thead { tr { @for (column, name) in header.iter().enumerate() { th class=(class(column)) { (name) } } } }
                tbody {
                    @for row in rows {
                        tr { @for (column, cell) in row.iter().enumerate() { td class=(class(column)) { (name(cell)) } } }
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
