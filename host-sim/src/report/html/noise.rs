//! Which tensors the noise at the output comes from.

use super::plot::px;
use super::{data, name, table};
use crate::noise::{NoiseShare, NoiseShares};
use crate::report::figures::{decibels, figure};
use maud::{Markup, html};

/// Bars that are drawn; the table has all.
const SHOWN: usize = 24;

pub(super) fn section(noise: &NoiseShares) -> Markup {
    let measured = noise.shares.len();
    let about = html! {
        "Share of each tensor's own quantization in the error at " code { (noise.measured) } ", on frame "
        (noise.frame) ". Method: the error that a step makes by itself is added to the step's value in the f32 network, "
        "everything behind it runs again in f32, and the power of the error that arrives is the step's. Shares are of the "
        "sum over all measured steps. "
        @if measured < noise.candidates {
            b { "Measured: the " (measured) " steps with the lowest SQNR alone, of " (noise.candidates) "." }
        } @else {
            "Measured: all " (measured) " steps with an error of their own."
        }
        " With all steps in integers the SQNR there is " (decibels(noise.measured_sqnr_db)) "; the powers of the measured "
        "shares add up to " (decibels(sum_db(&noise.shares))) "."
    };
    let widest = noise.shares.first().map_or(1.0, |share| share.share).max(f64::MIN_POSITIVE);
    let content = html! {
        div.bars {
            @for share in noise.shares.iter().take(SHOWN) {
                div title={ "alone " (decibels(share.alone_sqnr_db)) } {
                    span.label { (name(&share.step)) }
                    svg viewBox="0 0 100 10" preserveAspectRatio="none" aria-hidden="true" {
                        rect x="0" y="1" height="8" width=(px(100.0 * share.share / widest)) {}
                    }
                    span.percent { (percent(share.share)) }
                }
            }
        }
        (data("Every share as a table", &shares(&noise.shares)))
    };
    super::section("noise", "Where the noise comes from", &about, &content)
}

/// SQNR of errors that add up in power.
fn sum_db(shares: &[NoiseShare]) -> Option<f64> {
    let noise: f64 = shares.iter().filter_map(|share| share.alone_sqnr_db).map(|db| 10_f64.powf(-db / 10.0)).sum();
    Some(-10.0 * noise.log10())
}

fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

fn shares(shares: &[NoiseShare]) -> Markup {
    let mut sum = 0.0;
    let mut row = |share: &NoiseShare| {
        sum += share.share;
        vec![
            share.step.clone(),
            share.position.to_string(),
            percent(share.share),
            percent(sum),
            figure(share.alone_sqnr_db, 1),
        ]
    };
    let rows: Vec<_> = shares.iter().map(&mut row).collect();
    table(&["step", "position", "share", "sum so far", "SQNR with it alone, dB"], 1, &rows)
}
