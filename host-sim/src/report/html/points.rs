//! Where both networks point to, on the front view, worst frame first.

use super::maps::png_uri;
use super::plot::px;
use super::{data, table};
use crate::points::Points;
use crate::report::FrameReport;
use crate::report::figures::figure;
use image::ExtendedColorType;
use maud::{Markup, html};
use model_compiler::frames::{Frame, RealMap};

/// Frames that are drawn.
const SHOWN: usize = 6;
/// Units of the drawing per pixel of the view.
const SCALE: f64 = 2.0;

pub(super) fn section(reports: &[FrameReport], frames: &[Frame]) -> Markup {
    let mut drawn: Vec<(&FrameReport, &Frame, &Points)> =
        reports.iter().zip(frames).filter_map(|(r, f)| Some((r, f, r.points.as_ref()?))).collect();
    if drawn.is_empty() {
        return html! {};
    }
    drawn.sort_by(|a, b| b.0.badness().total_cmp(&a.0.badness()));
    let about = html! {
        "The engine's points (" b { "squares" } ") and those of the f32 network (" b { "rings" } ") on the front view, "
        "worst frame first."
        @if drawn.len() > SHOWN { " Drawn are " (SHOWN) " of " (drawn.len()) " frames." }
    };
    let content = html! {
        @for (report, frame, points) in drawn.iter().take(SHOWN) {
            article.frame {
                h3 { (report.name) span.note { (errors(report)) } }
                @if let Some(views) = &frame.views { (over_the_view(report, views, points)) }
            }
        }
        (data("Every point as a table", &all(reports)))
    };
    super::section("points", "Points", &about, &content)
}

fn errors(report: &FrameReport) -> String {
    match report.point_error_px.as_slice() {
        [] => String::new(),
        errors => {
            let errors: Vec<String> = errors.iter().map(|&pixels| figure(Some(pixels), 2)).collect();
            format!("{} px apart", errors.join(", "))
        }
    }
}

fn over_the_view(report: &FrameReport, views: &RealMap, points: &Points) -> Markup {
    let (width, height) = (f64::from(views.shape.width), f64::from(views.shape.height));
    // From the centers of the first pixels to those of the last.
    let at = |[x, y]: [f64; 2]| {
        let position = |p: f64, size: f64| SCALE * (0.5 + 0.5 * (p + 1.0) * (size - 1.0));
        (position(x, width), position(y, height))
    };
    html! {
        svg.detail viewBox={ "0 0 " (px(SCALE * width)) " " (px(SCALE * height)) } role="img"
            aria-label={ "Points of frame " (report.name) " on its front view" } {
            image href=(front_uri(views)) width=(px(SCALE * width)) height=(px(SCALE * height)) {}
            @for (x, y) in report.reference_points.iter().flatten().map(|&point| at(point)) {
                circle.reference cx=(px(x)) cy=(px(y)) r="6" {}
            }
            @for (x, y) in points.iter().map(|&point| at(point)) {
                rect.engine x=(px(x - 3.0)) y=(px(y - 3.0)) width="6" height="6" {}
            }
        }
    }
}

/// The first of the views.
fn front_uri(views: &RealMap) -> String {
    let pixels = views.data.chunks(usize::from(views.shape.channels)).flat_map(|pixel| &pixel[..3]);
    let pixels: Vec<u8> = pixels.map(|&level| level.round() as u8).collect();
    png_uri(&pixels, views.shape.width.into(), views.shape.height.into(), ExtendedColorType::Rgb8)
}

fn all(reports: &[FrameReport]) -> Markup {
    let row = |frame: &FrameReport, network: &str, points: &Points| {
        let values = points.iter().flatten().map(|&value| figure(Some(value), 4));
        [frame.name.clone(), network.to_owned()].into_iter().chain(values).collect::<Vec<_>>()
    };
    let of_frame = |frame: &FrameReport| {
        let engine = frame.points.as_ref().map(|points| row(frame, "integers", points));
        let float = frame.reference_points.as_ref().map(|points| row(frame, "f32", points));
        engine.into_iter().chain(float).collect::<Vec<_>>()
    };
    let rows: Vec<_> = reports.iter().flat_map(of_frame).collect();
    let longest = rows.iter().map(Vec::len).max().unwrap_or(2);
    let columns = (1..=(longest - 2) / 2).flat_map(|k| [format!("x {k}"), format!("y {k}")]);
    let header: Vec<String> = ["frame", "network"].map(str::to_owned).into_iter().chain(columns).collect();
    table(&header.iter().map(String::as_str).collect::<Vec<_>>(), 2, &rows)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::tests::report;
    use firmware::tensor::Shape;

    #[test]
    fn points_are_drawn_on_the_front_view_and_listed() {
        let views = RealMap { shape: Shape::map(3, 5, 10), data: vec![7.0; 150] };
        let frame = Frame { views: Some(views), ..Frame::default() };
        let mut report = report().frames.remove(0);
        report.points = Some(vec![[1.0, 0.0]]);
        report.reference_points = Some(vec![[-1.0, -1.0]]);
        report.point_error_px = vec![4.12];
        let page = section(&[report], &[frame]).into_string();
        // The center of the last column and of the middle row, at two units per pixel; the first pixel's center.
        for part in ["x=\"6\" y=\"0\"", "cx=\"1\" cy=\"1\"", "4.12 px apart", "image/png", ">integers</td>"] {
            assert!(page.contains(part), "{part} in {page}");
        }
        assert!(section(&[], &[]).into_string().is_empty());
    }
}
