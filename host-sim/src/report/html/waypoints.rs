//! Where both networks would drive: over the LiDAR histogram, with the camera beside it, worst frame first.

use super::plot::px;
use super::text::figure;
use super::{data, table};
use crate::report::FrameReport;
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

/// `[right, forward]` in the plane of the drawing: forward is up.
fn place([right, forward]: [f64; 2]) -> (f64, f64) {
    (right, -forward)
}

fn from_above(report: &FrameReport, frame: &Frame, waypoints: &Waypoints, map: &ByteMap) -> Markup {
    let sensor = -SENSOR_AHEAD_M;
    let view = format!("{} {} {} {}", -LEFT_M, sensor - AHEAD_M, LEFT_M + RIGHT_M, AHEAD_M + 4.0);
    html! {
        svg.above viewBox=(view) role="img" aria-label={ "Waypoints of frame " (report.name) " over its LiDAR histogram" } {
            image.lidar href=(lidar_uri(map)) x=(-LEFT_M) y=(px(sensor - AHEAD_M)) width=(LEFT_M + RIGHT_M)
                height=(AHEAD_M) preserveAspectRatio="none" {}
            path.ego d="M-0.9,2V-2L0,-2.6L0.9,-2V2z" { title { "ego vehicle" } }
            @if let Some([right, y]) = frame.goal {
                path.goal d={ "M" (px(right - 1.0)) "," (px(y)) "h2m-1,-1v2" } { title { "goal" } }
            }
            (tracks(report, waypoints, 1.0))
        }
    }
}

/// The waypoints alone, as large as they fit.
fn detail(report: &FrameReport, waypoints: &Waypoints) -> Markup {
    let points = waypoints.iter().chain(report.reference_waypoints.iter().flatten()).map(|&w| place(w));
    let start = ((0.0_f64, 0.0_f64), (0.0_f64, 0.0_f64));
    let ((left, top), (right, bottom)) =
        points.fold(start, |(low, high), (x, y)| ((low.0.min(x), low.1.min(y)), (high.0.max(x), high.1.max(y))));
    let side = (right - left).max(bottom - top).max(1.0) * 1.3;
    let corner = ((left + right - side) / 2.0, (top + bottom - side) / 2.0);
    let view = format!("{:.2} {:.2} {side:.2} {side:.2}", corner.0, corner.1);
    // One meter, or a power of ten that is a good part of the picture.
    let bar = 10_f64.powf((side / 2.5).log10().floor());
    html! {
        svg.detail viewBox=(view) role="img" aria-label={ "Waypoints of frame " (report.name) } {
            path.grid d={ "M0," (px2(corner.1)) "v" (px2(side)) "M" (px2(corner.0)) ",0h" (px2(side)) }
                stroke-width=(px2(side / 300.0)) {}
            path.bound d={ "M" (px2(corner.0 + side * 0.05)) "," (px2(corner.1 + side * 0.96)) "h" (bar) }
                stroke-width=(px2(side / 120.0)) {}
            text x=(px2(corner.0 + side * 0.05)) y=(px2(corner.1 + side * 0.93)) font-size=(px2(side / 16.0)) {
                (bar) " m" }
            (tracks(report, waypoints, side / 40.0))
        }
    }
}

/// Both tracks from the origin; marks are `size` meters wide.
fn tracks(report: &FrameReport, waypoints: &Waypoints, size: f64) -> Markup {
    let half = size / 2.0;
    html! {
        @if let Some(reference) = &report.reference_waypoints {
            path.reference d=(track(reference)) stroke-width=(px2(size / 5.0))
                stroke-dasharray={ (px2(size)) " " (px2(size / 2.0)) } {}
            @for (x, y) in reference.iter().map(|&w| place(w)) {
                circle.reference cx=(px2(x)) cy=(px2(y)) r=(px2(half * 1.3)) stroke-width=(px2(size / 5.0)) {}
            }
        }
        path.engine d=(track(waypoints)) stroke-width=(px2(size / 5.0)) {}
        @for (x, y) in waypoints.iter().map(|&w| place(w)) {
            rect.engine x=(px2(x - half / 2.0)) y=(px2(y - half / 2.0)) width=(px2(half)) height=(px2(half)) {}
        }
    }
}

fn track(waypoints: &Waypoints) -> String {
    let to = |(x, y): (f64, f64)| format!("L{},{}", px2(x), px2(y));
    waypoints.iter().map(|&w| to(place(w))).fold("M0,0".to_owned(), |path, point| path + &point)
}

/// A coordinate in meters, to the centimeter.
fn px2(meters: f64) -> String {
    format!("{meters:.2}")
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

fn png_uri(pixels: &[u8], width: usize, height: usize, color: ExtendedColorType) -> String {
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
