//! Attention statistics: how often queries look across, and how far integers and f32 agree.

use super::table;
use crate::attention::queries::{Queries, SensorQueries};
use crate::attention::statistics::{Agreement, CrossModal};
use crate::attention::{AttentionReport, NetworkAttention};
use crate::report::figures::listed;
use maud::{Markup, html};

mod cells;

pub(super) use cells::section as cells;

/// Frames in the table.
const LISTED: usize = 200;

/// Head of the page and figures of the whole.
pub(super) fn summary(report: &AttentionReport) -> Markup {
    let networks = networks(report);
    let name = networks.first().map_or("", |(_, network)| network.model.name.as_str());
    let known = &report.calibration_frames;
    html! {
        header {
            p.kicker { "Attention across the sensors" }
            h1 { (name) " " span.for { "at " (report.block) } }
            p.meta {
                @for (label, network) in &networks {
                    @let sha256 = &network.model.sha256;
                    (label) " sha256 " code title=(sha256) { (sha256.get(..16).unwrap_or("")) "…" } " · "
                }
                (report.heads) " heads · " (report.frames.len()) " frames"
            }
            @if !known.is_empty() {
                p.notice {
                    b { (known.len()) " of " (report.frames.len()) " frames are also calibration frames" }
                    ", so figures against f32 flatter: " (known.join(", "))
                }
            }
        }
        dl.figures {
            @for (name, value, note) in figures(report) {
                div { dt { (name) } dd { (value) span.note { (note) } } }
            }
        }
    }
}

fn networks(report: &AttentionReport) -> Vec<(&'static str, &NetworkAttention)> {
    let networks = [("integers", &report.int8), ("f32", &report.float)];
    networks.into_iter().filter_map(|(label, network)| Some((label, network.as_ref()?))).collect()
}

fn figures(report: &AttentionReport) -> Vec<(String, String, String)> {
    let mut figures = Vec::new();
    if let Some(agreement) = &report.agreement {
        let note = format!(
            "strongest keys that are the same; all {} in {} of rows, the first in {}",
            report.top,
            percent(agreement.sets_percent),
            percent(agreement.first_percent)
        );
        figures.push(("Integers and f32 agree".to_owned(), percent(agreement.keys_percent), note));
    }
    let networks = networks(report);
    for (name, of) in [
        ("Image looks at LiDAR", (|n| n.statistics.image) as fn(&NetworkAttention) -> CrossModal),
        ("LiDAR looks at image", |n| n.statistics.lidar),
    ] {
        let any =
            |(label, network): &(&str, &NetworkAttention)| format!("{label} {}", percent(of(network).any_percent));
        let Some((_, network)) = networks.first() else { continue };
        let each: Vec<String> = networks.iter().map(any).collect();
        let note = format!("of queries, with at least one of their {} strongest keys; {}", report.top, each.join(", "));
        figures.push((name.to_owned(), percent(of(network).any_percent), note));
    }
    figures
}

/// How often queries of one sensor look at the other.
pub(super) fn statistics(report: &AttentionReport) -> Markup {
    let Queries { image, lidar } = &report.queries;
    let about = html! {
        "A query looks across where, in any of its heads, at least one (or all) of its " (report.top) " strongest keys "
        "belong to the other sensor. Asked are " (asked("image tokens", image)) " and " (asked("LiDAR tokens", lidar))
        ", counted from above and from far to near; percentages are over frames and queries."
    };
    let header =
        ["queries", "network", &format!("all {} across, %", report.top), "at least 1 across, %", "ties, % of rows"];
    let row = |sensor: &str, network: &str, figures: CrossModal, tied: f64| {
        let figures = [figures.all_percent, figures.any_percent, tied].map(|percent| format!("{percent:.2}"));
        [sensor, network].map(str::to_owned).into_iter().chain(figures).collect::<Vec<_>>()
    };
    let mut rows = Vec::new();
    for (label, network) in networks(report) {
        let figures = network.statistics;
        rows.push(row("image", label, figures.image, figures.tied_percent));
        rows.push(row("LiDAR", label, figures.lidar, figures.tied_percent));
    }
    rows.sort_by_key(|row| row[0] != "image");
    super::section("statistics", "How often a query looks across", &about, &table(&header, 2, &rows))
}

fn asked(what: &str, queries: &SensorQueries) -> String {
    let [rows, columns] = queries.grid;
    format!("rows {} of {rows}×{columns} {what}", listed(&queries.rows))
}

/// Agreement per frame, the least first.
pub(super) fn frames(report: &AttentionReport) -> Markup {
    let mut frames: Vec<_> = report.frames.iter().filter_map(|f| Some((f.name.as_str(), f.agreement?))).collect();
    if frames.is_empty() {
        return html! {};
    }
    frames.sort_by(|a, b| a.1.keys_percent.total_cmp(&b.1.keys_percent));
    let row = |(name, agreement): &(&str, Agreement)| {
        let figures = [agreement.keys_percent, agreement.sets_percent, agreement.first_percent];
        [(*name).to_owned()].into_iter().chain(figures.map(|percent| format!("{percent:.2}"))).collect()
    };
    let rows: Vec<Vec<String>> = frames.iter().take(LISTED).map(row).collect();
    let about = html! {
        "Of the strongest keys of every head and query."
        @if frames.len() > LISTED { " Shown are " (LISTED) " of " (frames.len()) " frames." }
    };
    let header = ["frame", "same keys, %", "same sets, % of rows", "same strongest, % of rows"];
    super::section("frames", "Agreement of integers and f32 by frame", &about, &table(&header, 1, &rows))
}

fn percent(percent: f64) -> String {
    format!("{percent:.2} %")
}

#[cfg(test)]
mod tests;
