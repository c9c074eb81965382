//! Attention statistics as text.

use super::table;
use crate::attention::AttentionReport;
use crate::report::figures::listed;
use std::fmt::Write;

/// How often queries look across, per sensor and network, and how far the networks agree.
pub fn attention(report: &AttentionReport) -> String {
    let mut text = format!("{}, {} heads, {} frames\n", report.block, report.heads, report.frames.len());
    for (sensor, queries) in [("image", &report.queries.image), ("LiDAR", &report.queries.lidar)] {
        let [rows, columns] = queries.grid;
        let (tokens, chosen) = (queries.tokens.len(), listed(&queries.rows));
        let _ = writeln!(text, "{sensor} queries: {tokens} of {rows}×{columns} tokens, rows {chosen}");
    }
    let header = ["queries", "network", &format!("all {} across %", report.top), "at least 1 across %"];
    let networks = [("int8", &report.int8), ("f32", &report.float)];
    let mut rows = Vec::new();
    for sensor in ["image", "LiDAR"] {
        for (network, found) in networks {
            let Some(found) = found else { continue };
            let figures = if sensor == "image" { found.statistics.image } else { found.statistics.lidar };
            let percent = [figures.all_percent, figures.any_percent].map(|percent| format!("{percent:.2}"));
            rows.push([sensor, network].map(str::to_owned).into_iter().chain(percent).collect());
        }
    }
    let _ = writeln!(text, "\n{}\n", table(header.map(str::to_owned).to_vec(), &[0, 1], rows.into_iter()));
    if let Some(agreement) = &report.agreement {
        let _ = writeln!(
            text,
            "int8 and f32 agree on   {:.2} % of the strongest keys, all {} in {:.2} % of {} rows, the first in {:.2} %",
            agreement.keys_percent, report.top, agreement.sets_percent, agreement.rows, agreement.first_percent
        );
    }
    for (network, found) in networks {
        if let Some(found) = found.as_ref().filter(|found| found.statistics.tied_percent > 0.0) {
            let percent = found.statistics.tied_percent;
            let _ = writeln!(text, "ties in {network:<16}{percent:.2} % of rows: the lowest token was taken");
        }
    }
    text + &super::gates(&report.gates)
}
