//! Where single queries look: their strongest keys over camera image and LiDAR histogram, the integers beside f32.

use super::percent;
use crate::attention::queries::{Queries, SensorQueries};
use crate::attention::statistics::StrongestKeys;
use crate::attention::{AttentionReport, FrameAttention};
use crate::report::html::maps::{lidar_uri, small_camera_uri};
use crate::report::html::plot::px;
use crate::report::html::{data, table};
use maud::{Markup, html};
use model_compiler::frames::Frame;
use std::collections::BTreeMap;

/// Frames that are drawn.
const SHOWN: usize = 6;
/// Width of a drawing, and of the histogram in it.
const WIDTH: f64 = 650.0;
/// Height of the camera image in it.
const CAMERA_HEIGHT: f64 = 360.0;
/// Height of the embedded camera image, pixels.
const CAMERA_PIXELS: u32 = 192;
/// Between both maps.
const GAP: f64 = 14.0;
/// Size of a cell of the histogram, lateral and longitudinal, m.
const CELL_M: [f64; 2] = [65.0 / 256.0, 32.0 / 256.0];

/// Drawings, the frames with the least agreement first.
pub(in crate::report::html) fn section(report: &AttentionReport, frames: &[Frame]) -> Markup {
    let mut drawn: Vec<(&FrameAttention, &Frame)> = report.frames.iter().zip(frames).collect();
    let keys_percent = |frame: &FrameAttention| frame.agreement.map_or(0.0, |agreement| agreement.keys_percent);
    drawn.sort_by(|a, b| keys_percent(a.0).total_cmp(&keys_percent(b.0)));
    let compared = report.agreement.is_some();
    let about = html! {
        "The strongest keys of one query, over all heads: camera image above, LiDAR histogram from above below it, "
        "forward is up. Dotted cells are the queries that are counted; choose one by a click or from the list."
        @if drawn.len() > SHOWN { " Drawn are " (SHOWN) " of " (drawn.len()) " frames." }
        @if compared { " The frames on which integers and f32 agree least come first." }
    };
    let content = html! {
        (legend(report.heads, compared))
        @for (index, (attention, frame)) in drawn.iter().take(SHOWN).enumerate() {
            (article(index, report, attention, frame))
        }
    };
    crate::report::html::section("cells", "Where queries look", &about, &content)
}

fn legend(heads: u16, compared: bool) -> Markup {
    let swatch = |class: &str, opacity: f64| {
        html! {
            svg.attention width="22" height="16" viewBox="0 0 22 16" aria-hidden="true" {
                path class=(class) fill-opacity=(opacity_text(opacity)) d="M3,2h16v12h-16z" {}
            }
        }
    };
    html! {
        p.legend {
            span { (swatch("query", 0.0)) " the query" }
            span { (swatch("key", opacity(1, heads))) " among the strongest keys of one head" }
            @if heads > 1 { span { (swatch("key", opacity(heads, heads))) " of all " (heads) " heads" } }
            @if compared { span { (swatch("key only", opacity(1, heads))) " only in this network" } }
        }
    }
}

fn article(index: usize, report: &AttentionReport, attention: &FrameAttention, frame: &Frame) -> Markup {
    let stage = Stage::new(index, &report.queries, frame);
    let (int8, float) = (attention.int8.as_ref(), attention.float.as_ref());
    let networks = [("integers", int8, float), ("f32", float, int8)];
    let networks: Vec<_> =
        networks.into_iter().filter_map(|(label, keys, other)| Some((label, keys?, other))).collect();
    let shown = most_across(attention, &report.queries);
    html! {
        article.frame.looks {
            h3 {
                (attention.name)
                span.note {
                    @if let Some(agreement) = &attention.agreement {
                        (percent(agreement.keys_percent)) " of the strongest keys are the same in integers and f32"
                    }
                }
            }
            div.columns {
                @for (position, (label, keys, other)) in networks.into_iter().enumerate() {
                    figure.look {
                        figcaption { b { (label) } }
                        (stage.draw(label, keys, other, report, shown, position == 0))
                    }
                }
            }
            (data("Every query of this frame as a table", &queries_table(report, attention)))
        }
    }
}

/// The query with the most keys in the other sensor, the first of equals.
fn most_across(attention: &FrameAttention, queries: &Queries) -> usize {
    let Some(keys) = attention.int8.as_ref().or(attention.float.as_ref()) else { return 0 };
    let across = |query: &usize| keys.across(*query, queries).sum::<usize>();
    (0..queries.tokens().count()).rev().max_by_key(across).unwrap_or(0)
}

/// Where tokens lie in a drawing.
struct Stage<'a> {
    index: usize,
    queries: &'a Queries,
    frame: &'a Frame,
    camera_width: f64,
    lidar_height: f64,
}

impl<'a> Stage<'a> {
    fn new(index: usize, queries: &'a Queries, frame: &'a Frame) -> Self {
        let camera = frame.rgb.as_ref().map_or(1.0, |map| f64::from(map.shape.width) / f64::from(map.shape.height));
        let lidar = frame.bev.as_ref().map_or(CELL_M[1] / CELL_M[0], |map| {
            CELL_M[1] * f64::from(map.shape.width) / (CELL_M[0] * f64::from(map.shape.height))
        });
        let camera_width = (CAMERA_HEIGHT * camera).min(WIDTH);
        Self { index, queries, frame, camera_width, lidar_height: WIDTH * lidar }
    }

    fn lidar_top(&self) -> f64 {
        CAMERA_HEIGHT + GAP
    }

    /// Left, top, width and height of a token.
    fn cell(&self, token: u16) -> [f64; 4] {
        if self.queries.is_lidar(token) {
            let [rows, columns] = self.queries.lidar.grid;
            let at = token - self.queries.lidar.first_token;
            let (row, column) = (at / columns, at % columns);
            let (width, height) = (WIDTH / f64::from(rows), self.lidar_height / f64::from(columns));
            // Row 0 is rightmost, column 0 farthest.
            [f64::from(rows - 1 - row) * width, self.lidar_top() + f64::from(column) * height, width, height]
        } else {
            let [rows, columns] = self.queries.image.grid;
            let (width, height) = (self.camera_width / f64::from(columns), CAMERA_HEIGHT / f64::from(rows));
            let left = (WIDTH - self.camera_width) / 2.0;
            [left + f64::from(token % columns) * width, f64::from(token / columns) * height, width, height]
        }
    }

    /// Outlines of tokens, a little inside their cells.
    fn outline(&self, tokens: impl IntoIterator<Item = u16>, inset: f64) -> String {
        let outline = |token: u16| {
            let [x, y, width, height] = self.cell(token);
            let (width, height) = (width - 2.0 * inset, height - 2.0 * inset);
            format!("M{},{}h{}v{}h{}z", px(x + inset), px(y + inset), px(width), px(height), px(-width))
        };
        tokens.into_iter().map(outline).collect()
    }

    /// One network's drawing. The first of a frame holds the pictures, which the second takes from it.
    fn draw(
        &self,
        label: &str,
        keys: &StrongestKeys,
        other: Option<&StrongestKeys>,
        report: &AttentionReport,
        shown: usize,
        first: bool,
    ) -> Markup {
        let bottom = self.lidar_top() + self.lidar_height;
        let tokens: Vec<u16> = self.queries.tokens().collect();
        html! {
            svg.attention viewBox={ "0 0 " (WIDTH) " " (px(bottom + 24.0)) } role="img"
                aria-label={ "Strongest keys of " (label) " on frame " (self.frame.name) } {
                @if first { (self.pictures()) } @else {
                    use href={ "#camera-" (self.index) } {}
                    use href={ "#lidar-" (self.index) } {}
                }
                path.tokens d=(self.outline(0..self.queries.lidar.first_token, 0.0)) {}
                path.tokens d=(self.outline(self.lidar_tokens(), 0.0)) {}
                @for (query, &token) in tokens.iter().enumerate() {
                    g.query-keys.shown[query == shown] data-query=(query) {
                        @for ((heads, only), cells) in grouped(query, keys, other) {
                            path.key.only[only] fill-opacity=(opacity_text(opacity(heads, report.heads)))
                                d=(self.outline(cells, 2.0)) {}
                        }
                        path.query d=(self.outline([token], 0.0)) {}
                        text x="0" y=(px(bottom + 18.0)) { (caption(query, token, keys, self.queries)) }
                    }
                }
                @for (query, &token) in tokens.iter().enumerate() {
                    @let [x, y, width, height] = self.cell(token);
                    circle.dot cx=(px(x + width / 2.0)) cy=(px(y + height / 2.0)) r="2" {}
                    rect.pick data-query=(query) x=(px(x)) y=(px(y)) width=(px(width)) height=(px(height)) {
                        title { (token_name(token, self.queries)) }
                    }
                }
            }
        }
    }

    fn lidar_tokens(&self) -> std::ops::Range<u16> {
        let SensorQueries { grid: [rows, columns], first_token, .. } = self.queries.lidar;
        first_token..first_token + rows * columns
    }

    fn pictures(&self) -> Markup {
        let left = (WIDTH - self.camera_width) / 2.0;
        html! {
            g id={ "camera-" (self.index) } {
                @if let Some(map) = &self.frame.rgb {
                    image href=(small_camera_uri(map, CAMERA_PIXELS)) x=(px(left)) y="0" width=(px(self.camera_width))
                        height=(px(CAMERA_HEIGHT)) preserveAspectRatio="none" {}
                }
            }
            g id={ "lidar-" (self.index) } {
                @if let Some(map) = &self.frame.bev {
                    image.lidar href=(lidar_uri(map)) x="0" y=(px(self.lidar_top())) width=(px(WIDTH))
                        height=(px(self.lidar_height)) preserveAspectRatio="none" {}
                }
            }
        }
    }
}

/// The keys of a query by the number of heads that have them and whether the other network lacks them.
fn grouped(query: usize, keys: &StrongestKeys, other: Option<&StrongestKeys>) -> BTreeMap<(u16, bool), Vec<u16>> {
    let of = |keys: &StrongestKeys| {
        let mut heads: BTreeMap<u16, u16> = BTreeMap::new();
        keys.keys.iter().flat_map(|head| &head[query]).for_each(|&key| *heads.entry(key).or_default() += 1);
        heads
    };
    let there = other.map(of);
    let mut groups: BTreeMap<(u16, bool), Vec<u16>> = BTreeMap::new();
    for (key, heads) in of(keys) {
        let only = there.as_ref().is_some_and(|there| !there.contains_key(&key));
        groups.entry((heads, only)).or_default().push(key);
    }
    groups
}

/// Darker where more heads look.
fn opacity(heads: u16, of: u16) -> f64 {
    0.22 + 0.48 * f64::from(heads - 1) / f64::from(of.saturating_sub(1).max(1))
}

fn opacity_text(opacity: f64) -> String {
    format!("{opacity:.2}")
}

fn caption(query: usize, token: u16, keys: &StrongestKeys, queries: &Queries) -> String {
    let other = if queries.is_lidar(token) { "image" } else { "LiDAR" };
    let across: Vec<String> = keys.across(query, queries).map(|count| count.to_string()).collect();
    format!("{}: keys in the {other}, by head: {}", token_name(token, queries), across.join(", "))
}

fn token_name(token: u16, queries: &Queries) -> String {
    if queries.is_lidar(token) {
        let at = token - queries.lidar.first_token;
        let [rows, columns] = queries.lidar.grid;
        format!("LiDAR row {}, column {}", at % columns, rows - 1 - at / columns)
    } else {
        let columns = queries.image.grid[1];
        format!("image row {}, column {}", token / columns, token % columns)
    }
}

fn queries_table(report: &AttentionReport, attention: &FrameAttention) -> Markup {
    let queries = &report.queries;
    let across = |keys: &Option<StrongestKeys>, query: usize| {
        let keys = keys.as_ref()?;
        let counts: Vec<String> = keys.across(query, queries).map(|count| count.to_string()).collect();
        Some(counts.join(", "))
    };
    let common = |query: usize| {
        let (int8, float) = (attention.int8.as_ref()?, attention.float.as_ref()?);
        let shared =
            |(a, b): (&Vec<Vec<u16>>, &Vec<Vec<u16>>)| a[query].iter().filter(|key| b[query].contains(key)).count();
        let counts: Vec<String> = int8.keys.iter().zip(&float.keys).map(|pair| shared(pair).to_string()).collect();
        Some(counts.join(", "))
    };
    let row = |(query, token): (usize, u16)| {
        let cells = [across(&attention.int8, query), across(&attention.float, query), common(query)];
        let cells = cells.into_iter().map(|cell| cell.unwrap_or_else(|| "–".to_owned()));
        [token_name(token, queries)].into_iter().chain(cells).collect()
    };
    let rows: Vec<Vec<String>> = queries.tokens().enumerate().map(row).collect();
    table(&["query", "integers, keys across by head", "f32, keys across by head", "keys in both, by head"], 1, &rows)
}

#[cfg(test)]
mod tests {
    use super::super::tests::report;
    use super::*;
    use crate::report::html::tests::frame;

    #[test]
    fn keys_are_grouped_by_heads_and_by_what_the_other_lacks() {
        let report = report();
        let (int8, float) = (report.frames[0].int8.as_ref().unwrap(), report.frames[0].float.as_ref());
        let groups: Vec<_> = grouped(0, int8, float).into_iter().collect();
        assert_eq!(groups, [((1, true), vec![2, 4]), ((2, false), vec![0, 1])]);
        assert_eq!(grouped(0, int8, None).len(), 2);
        assert_eq!(most_across(&report.frames[0], &report.queries), 3);
    }

    #[test]
    fn tokens_lie_where_their_map_is_drawn() {
        let (report, frame) = (report(), frame());
        let stage = Stage::new(0, &report.queries, &frame);
        assert_eq!(stage.cell(3), [WIDTH / 2.0, CAMERA_HEIGHT / 2.0, CAMERA_HEIGHT / 2.0, CAMERA_HEIGHT / 2.0]);
        // The first LiDAR token is the farthest on the right.
        let [x, y, width, height] = stage.cell(4);
        assert_eq!((x, y, width), (WIDTH / 2.0, CAMERA_HEIGHT + GAP, WIDTH / 2.0));
        assert_eq!(stage.cell(9)[..2], [0.0, y + 2.0 * height]);
        assert_eq!(
            (token_name(4, &report.queries), token_name(9, &report.queries)),
            ("LiDAR row 0, column 1".into(), "LiDAR row 2, column 0".into())
        );
    }
}
