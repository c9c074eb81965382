//! Where both networks would drive: over the LiDAR histogram, with the camera beside it, worst frame first.

use super::plot::{line, px};
use super::{data, table};
use crate::report::FrameReport;
use crate::report::figures::figure;
use crate::run::Waypoints;
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use maud::{Markup, html};
use model_compiler::frames::{ByteMap, Frame, bev};

/// Frames that are drawn.
const SHOWN: usize = 6;
/// The sensor sits ahead of the origin of the waypoints, m.
const SENSOR_AHEAD_M: f64 = 1.3;
/// Area of the histogram, m: left, right and ahead of the sensor.
const LEFT_M: f64 = 33.0;
const RIGHT_M: f64 = 32.0;
const AHEAD_M: f64 = 32.0;
/// Units of the drawing per meter of the histogram.
const ABOVE_SCALE: f64 = 10.0;
/// Side of the drawing of the waypoints alone.
const DETAIL: f64 = 340.0;

pub(super) fn section(reports: &[FrameReport], frames: &[Frame]) -> Markup {
    let mut drawn: Vec<(&FrameReport, &Frame, &Waypoints)> =
        reports.iter().zip(frames).filter_map(|(r, f)| Some((r, f, r.waypoints.as_ref()?))).collect();
    if drawn.is_empty() {
        return html! {};
    }
    drawn.sort_by(|a, b| b.0.badness().total_cmp(&a.0.badness()));
    let about = html! {
        "The engine's waypoints (" b { "squares, solid line" } ") and those of the f32 network (" b { "rings, dashed "
        "line" } "), worst frame first, with the goal as a cross. Left: the LiDAR histogram from above, forward is up, "
        "65 m × 32 m; middle: the waypoints by themselves; right: the camera."
        @if drawn.len() > SHOWN { " Drawn are " (SHOWN) " of " (drawn.len()) " frames." }
    };
    let content = html! {
        @for (report, frame, waypoints) in drawn.iter().take(SHOWN) {
            article.frame {
                h3 { (report.name) span.note { (errors(report)) } }
                div.views {
                    @if let Some(map) = &frame.bev { (from_above(report, frame, waypoints, map)) }
                    (detail(report, waypoints))
                    @if let Some(camera) = &frame.rgb {
                        img.camera src=(camera_uri(camera)) alt={ "Camera of frame " (report.name) };
                    }
                }
            }
        }
        (data("Every waypoint as a table", &all(reports)))
    };
    super::section("waypoints", "Waypoints", &about, &content)
}

fn errors(report: &FrameReport) -> String {
    match report.waypoint_error_mm.as_slice() {
        [] => String::new(),
        errors => {
            let errors: Vec<String> = errors.iter().map(|&mm| figure(Some(mm), 0)).collect();
            format!("{} mm apart", errors.join(", "))
        }
    }
}

/// A window into the plane of the road, forward up, in units of the drawing.
#[derive(Clone, Copy)]
struct View {
    /// Right and forward of the upper left corner, m.
    corner: [f64; 2],
    /// Units per meter.
    scale: f64,
}

impl View {
    fn at(&self, [right, forward]: [f64; 2]) -> (f64, f64) {
        (self.scale * (right - self.corner[0]), self.scale * (self.corner[1] - forward))
    }

    fn track(&self, waypoints: &Waypoints) -> String {
        line([&[0.0, 0.0]].into_iter().chain(waypoints).map(|&waypoint| Some(self.at(waypoint))))
    }
}

fn from_above(report: &FrameReport, frame: &Frame, waypoints: &Waypoints, map: &ByteMap) -> Markup {
    let view = View { corner: [-LEFT_M, SENSOR_AHEAD_M + AHEAD_M], scale: ABOVE_SCALE };
    let (width, height) = (ABOVE_SCALE * (LEFT_M + RIGHT_M), ABOVE_SCALE * AHEAD_M);
    let (x, y) = view.at([0.0, 0.0]);
    html! {
        svg.above viewBox={ "0 0 " (px(width)) " " (px(height + 4.0 * ABOVE_SCALE)) } role="img"
            aria-label={ "Waypoints of frame " (report.name) " over its LiDAR histogram" } {
            image.lidar href=(lidar_uri(map)) width=(px(width)) height=(px(height)) preserveAspectRatio="none" {}
            path.ego d={ "M" (px(x - 9.0)) "," (px(y + 22.0)) "v-42l9,-6l9,6v42z" } { title { "ego vehicle" } }
            @if let Some([right, y]) = frame.goal {
                @let (x, y) = view.at([right, -y]);
                path.goal d={ "M" (px(x - 9.0)) "," (px(y)) "h18m-9,-9v18" } { title { "goal" } }
            }
            (tracks(report, waypoints, view))
        }
    }
}

/// The waypoints alone, as large as they fit.
fn detail(report: &FrameReport, waypoints: &Waypoints) -> Markup {
    let points = waypoints.iter().chain(report.reference_waypoints.iter().flatten());
    let (low, high) = points.fold(([0.0_f64; 2], [0.0_f64; 2]), |(low, high), &[right, forward]| {
        ([low[0].min(right), low[1].min(forward)], [high[0].max(right), high[1].max(forward)])
    });
    let side = (high[0] - low[0]).max(high[1] - low[1]).max(1.0) * 1.25;
    let corner = [(low[0] + high[0] - side) / 2.0, (low[1] + high[1] + side) / 2.0];
    let view = View { corner, scale: DETAIL / side };
    let (x, y) = view.at([0.0, 0.0]);
    // The greatest power of ten that is at most four tenths of the side.
    let bar = 10_f64.powf((0.4 * side).log10().floor());
    html! {
        svg.detail viewBox={ "0 0 " (DETAIL) " " (DETAIL) } role="img" aria-label={ "Waypoints of frame " (report.name) } {
            path.grid d={ "M" (px(x)) ",0V" (DETAIL) "M0," (px(y)) "H" (DETAIL) } {}
            path.scale d={ "M12," (px(DETAIL - 12.0)) "h" (px(bar * view.scale)) } {}
            text x="12" y=(px(DETAIL - 20.0)) { (bar) " m" }
            (tracks(report, waypoints, view))
        }
    }
}

/// Both tracks from the origin.
fn tracks(report: &FrameReport, waypoints: &Waypoints, view: View) -> Markup {
    html! {
        @if let Some(reference) = &report.reference_waypoints {
            path.reference d=(view.track(reference)) {}
            @for (x, y) in reference.iter().map(|&w| view.at(w)) { circle.reference cx=(px(x)) cy=(px(y)) r="6" {} }
        }
        path.engine d=(view.track(waypoints)) {}
        @for (x, y) in waypoints.iter().map(|&w| view.at(w)) {
            rect.engine x=(px(x - 3.0)) y=(px(y - 3.0)) width="6" height="6" {}
        }
    }
}

/// The histogram from above: rows become columns, right is right, far is up; denser cells are darker.
fn lidar_uri(map: &ByteMap) -> String {
    let (rows, columns) = (usize::from(map.shape.height), usize::from(map.shape.width));
    let channels = usize::from(map.shape.channels);
    let mut pixels = Vec::with_capacity(2 * rows * columns);
    for column in 0..columns {
        for row in (0..rows).rev() {
            let cell = &map.data[(row * columns + column) * channels..][..channels];
            let count: u32 = cell.iter().map(|&count| u32::from(count)).sum();
            let full = u32::from(bev::MAX_COUNT) * channels as u32;
            let shade = if count == 0 { 0 } else { 80 + 175 * count.min(full) / full };
            pixels.extend([0, shade as u8]);
        }
    }
    png_uri(&pixels, rows, columns, ExtendedColorType::La8)
}

fn camera_uri(map: &ByteMap) -> String {
    png_uri(&map.data, map.shape.width.into(), map.shape.height.into(), ExtendedColorType::Rgb8)
}

/// A PNG file inside its address.
pub(super) fn png_uri(pixels: &[u8], width: usize, height: usize, color: ExtendedColorType) -> String {
    let mut bytes = Vec::new();
    let encoder = PngEncoder::new(&mut bytes);
    encoder.write_image(pixels, width as u32, height as u32, color).expect("a map has its shape's number of bytes");
    format!("data:image/png;base64,{}", BASE64_STANDARD.encode(bytes))
}

fn all(reports: &[FrameReport]) -> Markup {
    let row = |frame: &FrameReport, network: &str, waypoints: &Waypoints| {
        let meters = waypoints.iter().flatten().map(|&meters| figure(Some(meters), 3));
        [frame.name.clone(), network.to_owned()].into_iter().chain(meters).collect::<Vec<_>>()
    };
    let rows: Vec<_> = reports
        .iter()
        .flat_map(|frame| {
            let engine = frame.waypoints.iter().map(|w| row(frame, "integers", w));
            engine.chain(frame.reference_waypoints.iter().map(|w| row(frame, "f32", w)))
        })
        .collect();
    let longest = rows.iter().map(Vec::len).max().unwrap_or(2);
    let columns = (1..=(longest - 2) / 2).flat_map(|k| [format!("right {k}, m"), format!("forward {k}, m")]);
    let header: Vec<String> = ["frame", "network"].map(str::to_owned).into_iter().chain(columns).collect();
    table(&header.iter().map(String::as_str).collect::<Vec<_>>(), 2, &rows)
}

#[cfg(test)]
mod tests {
    use super::*;
    use firmware::tensor::Shape;

    #[test]
    fn the_histogram_is_turned_so_that_right_is_right_and_far_is_up() {
        // Row 0 is rightmost, column 0 farthest: one count there is the upper right corner.
        let mut map = ByteMap { shape: Shape::map(2, 2, 2), data: vec![0; 8] };
        map.data[0] = 5;
        let uri = lidar_uri(&map);
        let bytes = BASE64_STANDARD.decode(uri.strip_prefix("data:image/png;base64,").unwrap()).unwrap();
        let image = image::load_from_memory(&bytes).unwrap().into_luma_alpha8();
        let alpha = |x, y| image.get_pixel(x, y).0[1];
        assert!(alpha(1, 0) > 100 && alpha(0, 0) == 0 && alpha(0, 1) == 0 && alpha(1, 1) == 0);
    }
}
