//! The arena over time: where every buffer lies, from which step to which; a plot per memory region.

use super::plot::{Axis, LEFT, RIGHT, WIDTH, px};
use super::{data, table};
use crate::report::Summary;
use crate::report::figures::{bytes, short_bytes, short_name};
use crate::report::memory::{Buffer, MemoryReport, RegionReport};
use maud::{Markup, html};

const HEIGHT: f64 = 380.0;
const TOP: f64 = 16.0;
const BOTTOM: f64 = HEIGHT - 34.0;
const CHARACTER: f64 = 6.2;

pub(super) fn section(memory: &MemoryReport, summary: &Summary) -> Markup {
    if memory.buffers.is_empty() {
        return html! {};
    }
    let in_place = memory.buffers.iter().filter(|buffer| buffer.in_place_of.is_some()).count();
    let about = html! {
        "One rectangle per buffer: from left to right the steps that it lives through, from bottom to top its bytes in "
        "the arena. Hatched ones are scratch of a single step; a " b { "notch" } " on the left edge marks a tensor that "
        "takes over the memory of its operand (" (in_place) " of them). The vertical line is the peak, step "
        (memory.peak_step) ". The arena has " (bytes(summary.arena_bytes)) "; no plan for this order needs less than "
        (bytes(summary.arena_bound_bytes)) " (" (summary.arena_status.words()) ")."
        @if !memory.regions.is_empty() {
            " It lies in " (memory.regions.len()) " memory regions, fastest first; each has its own peak and bound."
        }
    };
    let content = html! {
        @if memory.regions.is_empty() {
            (plot(&Part::whole(memory, summary), true))
        }
        @for (number, region) in memory.regions.iter().enumerate() {
            h3 { (region.name) }
            p { (about_region(region)) }
            (plot(&Part::of(memory, region), number == 0))
        }
        (data("Every buffer as a table", &buffers(&memory.buffers)))
    };
    super::section("memory", "Memory plan", &about, &content)
}

/// What one plot shows.
struct Part<'a> {
    buffers: Vec<&'a Buffer>,
    last_step: u32,
    peak_step: u32,
    bytes: u64,
    bound_bytes: u64,
}

impl<'a> Part<'a> {
    fn whole(memory: &'a MemoryReport, summary: &Summary) -> Self {
        Self {
            buffers: memory.buffers.iter().collect(),
            last_step: last_step(memory),
            peak_step: memory.peak_step,
            bytes: summary.arena_bytes,
            bound_bytes: summary.arena_bound_bytes,
        }
    }

    fn of(memory: &'a MemoryReport, region: &RegionReport) -> Self {
        Self {
            buffers: memory.buffers.iter().filter(|buffer| buffer.region.as_ref() == Some(&region.name)).collect(),
            last_step: last_step(memory),
            peak_step: region.peak_step,
            bytes: region.bytes,
            bound_bytes: region.bound_bytes,
        }
    }
}

fn last_step(memory: &MemoryReport) -> u32 {
    memory.buffers.iter().map(|buffer| buffer.last_step).max().unwrap_or(0)
}

fn about_region(region: &RegionReport) -> String {
    let of = region.capacity_bytes.map(|capacity| format!(" of {}", bytes(capacity))).unwrap_or_default();
    format!(
        "{}{of}, bound {}: {}. {:.1} % of all bytes read and written.",
        bytes(region.bytes),
        bytes(region.bound_bytes),
        region.status.words(),
        100.0 * region.traffic_share
    )
}

/// The pattern of scratch is defined once, for all plots of the page.
fn plot(part: &Part<'_>, defines_pattern: bool) -> Markup {
    let x = Axis::new([-0.5, f64::from(part.last_step) + 0.5], [LEFT, RIGHT]);
    let top = part.bytes.max(part.bound_bytes).max(1) as f64;
    let y = Axis::new([0.0, top], [BOTTOM, TOP]);
    let unit = if top >= 4096.0 { 1024.0 } else { 1.0 };
    let ticks: Vec<f64> = Axis::new([0.0, top / unit], [0.0, 1.0]).ticks(6.0).into_iter().map(|t| t * unit).collect();
    html! {
        figure.plot {
            svg viewBox={ "0 0 " (WIDTH) " " (HEIGHT) } role="img"
                aria-label="Buffers of the arena over the steps; the same figures are in the table below" {
                @if defines_pattern {
                    defs { pattern #hatch width="6" height="6" patternUnits="userSpaceOnUse"
                        patternTransform="rotate(45)" { path d="M0,0V6" {} } }
                }
                (y.grid(&ticks, short_bytes))
                (x.labels(&x.ticks(10.0), HEIGHT - 16.0, |step| format!("{step:.0}")))
                text.mid x=(px((LEFT + RIGHT) / 2.0)) y=(px(HEIGHT - 2.0)) { "step" }
                @for buffer in &part.buffers { (rectangle(buffer, part.peak_step, &x, &y)) }
                path.peak d={ "M" (px(x.at(part.peak_step.into()))) "," (px(TOP - 10.0)) "V" (px(BOTTOM)) } {}
                path.bound d={ "M" (px(LEFT)) "," (px(y.at(part.bound_bytes as f64))) "H" (px(RIGHT)) } {
                    title { "lower bound " (bytes(part.bound_bytes)) } }
                text.end x=(px(RIGHT)) y=(px(y.at(part.bound_bytes as f64) - 4.0)) { "lower bound" }
            }
        }
    }
}

fn rectangle(buffer: &Buffer, peak: u32, x: &Axis, y: &Axis) -> Markup {
    let (left, right) = (x.at(f64::from(buffer.first_step) - 0.5), x.at(f64::from(buffer.last_step) + 0.5));
    let (low, high) = (y.at(buffer.offset as f64), y.at((buffer.offset + buffer.bytes) as f64));
    let at_peak = (buffer.first_step..=buffer.last_step).contains(&peak);
    let short = short_name(&buffer.name);
    let indent = if buffer.in_place_of.is_some() { 10.0 } else { 5.0 };
    let is_room = right - left > short.len() as f64 * CHARACTER + indent && low - high > 13.0;
    html! {
        g.buffer.scratch[buffer.scratch].at-peak[at_peak] {
            title { (hover(buffer)) }
            rect x=(px(left)) y=(px(high)) width=(px(right - left)) height=(px((low - high).max(0.5))) {}
            @if buffer.in_place_of.is_some() {
                @let (middle, size) = ((low + high) / 2.0, ((low - high) / 2.0).min(6.0));
                path.notch d={ "M" (px(left)) "," (px(middle - size)) "l" (px(size)) "," (px(size)) "l" (px(-size)) ","
                    (px(size)) "z" } {}
            }
            @if is_room { text x=(px(left + indent)) y=(px((low + high) / 2.0 + 4.0)) { (short) } }
        }
    }
}

fn hover(buffer: &Buffer) -> String {
    let kind = if buffer.scratch { "scratch of " } else { "" };
    let region = buffer.region.as_ref().map(|region| format!(" in {region}")).unwrap_or_default();
    let place = buffer.in_place_of.as_ref().map(|operand| format!(", over {operand}")).unwrap_or_default();
    format!(
        "{kind}{}: {} at {}{region}, steps {} to {}{place}",
        buffer.name,
        bytes(buffer.bytes),
        buffer.offset,
        buffer.first_step,
        buffer.last_step
    )
}

fn buffers(buffers: &[Buffer]) -> Markup {
    let several = buffers.iter().any(|buffer| buffer.region.is_some());
    let row = |buffer: &Buffer| {
        let mut row = vec![
            buffer.name.clone(),
            if buffer.scratch { "scratch" } else { "tensor" }.to_owned(),
            buffer.in_place_of.clone().unwrap_or_default(),
        ];
        row.extend(several.then(|| buffer.region.clone().unwrap_or_default()));
        let numbers = [buffer.offset, buffer.bytes, buffer.first_step.into(), buffer.last_step.into()];
        row.extend(numbers.map(|number| number.to_string()));
        row
    };
    let rows: Vec<_> = buffers.iter().map(row).collect();
    let mut headers = vec!["buffer", "kind", "takes over"];
    headers.extend(several.then_some("region"));
    let left = headers.len();
    headers.extend(["offset", "bytes", "first step", "last step"]);
    table(&headers, left, &rows)
}
