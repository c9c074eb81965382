//! Ready network inputs in a `.safetensors` file: `rgb` u8 `[N,3,H,W]`, `bev` u8 `[N,2,H,W]` (counts 0..=5), `velocity`
//! f32 `[N]`, `target` f32 `[N,2]` (network frame), `lbc_input` f32 `[N,10,H,W]` (views and heatmap, 0..=1), `command`
//! i32 `[N]` (1..=6), `bev_points` and `cam_points` i32 `[N,H,W,K,2]` (cells that see the same points).
//!
//! Of a classifier: the image by the network's own name for it, or as `rgb`, `[N,C,H,W]`, and optionally `label` i64
//! `[N]`. Images may be f32 as well; they are raw, so every value is a whole number 0..=255.

use super::views::LEVELS;
use super::{ByteMap, Frame, FrameFormat, Label, RealMap, bev};
use crate::error::{Error, ErrorCode, Result};
use firmware::tensor::Shape;
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use std::borrow::Cow;
use std::path::Path;

/// Loads the tensors that the network needs; others may be missing or of any shape.
pub(super) fn load(path: &Path, format: &FrameFormat) -> Result<Vec<Frame>> {
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, &e))?;
    let file = SafeTensors::deserialize(&bytes).map_err(|e| {
        Error::new(ErrorCode::Malformed, path.display().to_string(), format!("not a safetensors file: {e}"))
            .with_help("frames are a frame directory or a .safetensors file of raw network inputs")
    })?;
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    frames(&file, &stem, format).map_err(|e| e.within(path.display()))
}

fn frames(file: &SafeTensors<'_>, stem: &str, format: &FrameFormat) -> Result<Vec<Frame>> {
    let mut batch = Batch { file, frames: None };
    let rgb = format.image.map(|shape| batch.maps(batch.image_name(format), shape)).transpose()?;
    let bev = format.bev.map(|shape| batch.maps("bev", shape)).transpose()?;
    if let Some(count) = bev.iter().flatten().flat_map(|map| &map.data).find(|&&count| count > bev::MAX_COUNT) {
        return Err(tensor_error("bev", format!("holds {count}, expected counts 0..=5")));
    }
    let velocity = format.velocity.then(|| batch.floats("velocity", &[])).transpose()?;
    let goal = format.goal.then(|| batch.floats("target", &[2])).transpose()?;
    let points = |batch: &mut Batch<'_>, name| format.points.map(|shape| batch.cells(name, shape)).transpose();
    let (bev_points, camera_points) = (points(&mut batch, "bev_points")?, points(&mut batch, "cam_points")?);
    let command = batch.commands(format.command)?;
    let views = format.views.map(|shape| batch.views("lbc_input", shape)).transpose()?;
    let count = batch.frames.unwrap_or(0);
    let speeds = batch.speeds();
    let labels = format.classes.map(|classes| batch.labels(classes)).transpose()?.flatten();
    if count == 0 {
        return Err(Error::new(ErrorCode::Frames, "", "holds no frame that this network could read"));
    }
    let frame = |i: usize| Frame {
        name: format!("{stem}#{i}"),
        rgb: rgb.as_ref().map(|maps| maps[i].clone()),
        bev: bev.as_ref().map(|maps| maps[i].clone()),
        velocity: velocity.as_ref().map(|v| f64::from(v[i])),
        goal: goal.as_ref().map(|g| [f64::from(g[2 * i]), f64::from(g[2 * i + 1])]),
        views: views.as_ref().map(|maps| maps[i].clone()),
        command: command.as_ref().map(|c| c[i]),
        bev_points: bev_points.as_ref().map(|maps| maps[i].clone()),
        camera_points: camera_points.as_ref().map(|maps| maps[i].clone()),
        dropped_points: 0,
        label: labels.as_ref().map(|labels| labels[i].clone()),
        speed: speeds.as_ref().and_then(|speeds| speeds[i]),
    };
    Ok((0..count).map(frame).collect())
}

/// A file and the number of frames that its tensors agree on so far.
struct Batch<'a> {
    file: &'a SafeTensors<'a>,
    frames: Option<usize>,
}

impl<'a> Batch<'a> {
    /// The network's own name for its image, unless the file has only `rgb`.
    fn image_name<'n>(&self, format: &'n FrameFormat) -> &'n str {
        let has = |name: &str| self.file.tensor(name).is_ok();
        if has("rgb") && !has(&format.image_name) { "rgb" } else { &format.image_name }
    }

    fn tensor(&mut self, name: &str, element: Dtype, per_frame: &[usize]) -> Result<TensorView<'a>> {
        let Ok(view) = self.file.tensor(name) else {
            let error = tensor_error(name, "missing; this network needs it");
            return Err(error.with_help(format!("the file holds: {}", self.held())));
        };
        let fits = view.shape().split_first().filter(|(_, rest)| *rest == per_frame && view.dtype() == element);
        let frames = fits.map(|(&frames, _)| frames).filter(|&n| self.frames.is_none_or(|known| known == n));
        match frames {
            Some(n) => self.frames = Some(n),
            None => return Err(self.mismatch(name, &view, element, per_frame)),
        }
        Ok(view)
    }

    /// Names in the file, the first few of them.
    fn held(&self) -> String {
        const SHOWN: usize = 8;
        let mut names = self.file.names();
        names.sort_unstable();
        let more = names.len().saturating_sub(SHOWN);
        names.truncate(SHOWN);
        let rest = if more > 0 { format!(" and {more} more") } else { String::new() };
        names.join(", ") + &rest
    }

    fn mismatch(&self, name: &str, view: &TensorView<'_>, element: Dtype, per_frame: &[usize]) -> Error {
        let frames = self.frames.map_or("N".to_owned(), |n| n.to_string());
        let expected: Vec<String> = std::iter::once(frames).chain(per_frame.iter().map(usize::to_string)).collect();
        let message = format!("{:?} {:?}, expected {element:?} [{}]", view.dtype(), view.shape(), expected.join(", "));
        let help = match per_frame {
            [_, _, _] => "--resolution HxW sets the size of a network whose checkpoint does not tell it",
            _ => "",
        };
        tensor_error(name, message).with_help(help)
    }

    /// `[N][C][H][W]` to a channel-fastest map per frame.
    fn maps(&mut self, name: &str, shape: Shape) -> Result<Vec<ByteMap>> {
        let [height, width, channels] = [shape.height, shape.width, shape.channels].map(usize::from);
        let per_frame = [channels, height, width];
        let is_float = self.file.tensor(name).is_ok_and(|view| view.dtype() == Dtype::F32);
        let planes = match is_float {
            true => grey_levels(name, &self.floats(name, &per_frame)?)?.into(),
            false => Cow::Borrowed(self.tensor(name, Dtype::U8, &per_frame)?.data()),
        };
        let maps = planes.chunks_exact(channels * height * width);
        Ok(maps.map(|planes| ByteMap { shape, data: channel_fastest(planes, channels) }).collect())
    }

    /// `[N][C][H][W]` of values 0..=1 to a map of grey levels per frame.
    fn views(&mut self, name: &str, shape: Shape) -> Result<Vec<RealMap>> {
        let [height, width, channels] = [shape.height, shape.width, shape.channels].map(usize::from);
        let values = self.floats(name, &[channels, height, width])?;
        if let Some(value) = values.iter().find(|value| !(0.0..=1.0).contains(*value)) {
            return Err(tensor_error(name, format!("holds {value}, expected values 0..=1"))
                .with_help("grey levels are divided by 255, as the network reads them"));
        }
        let levels: Vec<f32> = values.iter().map(|value| value * LEVELS).collect();
        let maps = levels.chunks_exact(channels * height * width);
        Ok(maps.map(|planes| RealMap { shape, data: channel_fastest(planes, channels) }).collect())
    }

    /// `[N][H][W][K][2]` cells of a map as large, to a map of pairs per frame.
    fn cells(&mut self, name: &str, shape: Shape) -> Result<Vec<ByteMap>> {
        let [height, width, pairs] = [shape.height, shape.width, shape.channels / 2].map(usize::from);
        let view = self.tensor(name, Dtype::I32, &[height, width, pairs, 2])?;
        let number = |(i, &bytes): (usize, &[u8; 4])| {
            let (value, size) = (i32::from_le_bytes(bytes), if i % 2 == 0 { height } else { width });
            u8::try_from(value)
                .ok()
                .filter(|&cell| usize::from(cell) < size)
                .ok_or_else(|| tensor_error(name, format!("holds {value}, expected cells 0..={}", size - 1)))
        };
        let cells: Vec<u8> = view.data().as_chunks::<4>().0.iter().enumerate().map(number).collect::<Result<_>>()?;
        let maps = cells.chunks_exact(height * width * pairs * 2);
        Ok(maps.map(|data| ByteMap { shape, data: data.to_vec() }).collect())
    }

    fn labels(&mut self, classes: u16) -> Result<Option<Vec<Label>>> {
        if self.file.tensor("label").is_err() {
            return Ok(None);
        }
        let view = self.tensor("label", Dtype::I64, &[])?;
        let label = |(i, &bytes): (usize, &[u8; 8])| {
            let value = i64::from_le_bytes(bytes);
            let class = u16::try_from(value).ok().filter(|&class| class < classes).ok_or_else(|| {
                let last = classes.saturating_sub(1);
                tensor_error("label", format!("holds {value} for frame {i}, the network has classes 0..={last}"))
            })?;
            Ok(Label { class, name: String::new() })
        };
        view.data().as_chunks::<8>().0.iter().enumerate().map(label).collect::<Result<_>>().map(Some)
    }

    fn floats(&mut self, name: &str, per_frame: &[usize]) -> Result<Vec<f32>> {
        let view = self.tensor(name, Dtype::F32, per_frame)?;
        let values: Vec<f32> =
            view.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        match values.iter().find(|v| !v.is_finite()) {
            Some(value) => Err(tensor_error(name, format!("holds {value}, expected finite values"))),
            None => Ok(values),
        }
    }

    /// Forward speeds where `velocity` holds such for these frames, whether or not the network reads them.
    fn speeds(&self) -> Option<Vec<Option<f64>>> {
        let fits = |v: &TensorView<'_>| v.dtype() == Dtype::F32 && v.shape() == [self.frames.unwrap_or(0)];
        let view = self.file.tensor("velocity").ok().filter(fits)?;
        let speeds = view.data().as_chunks::<4>().0.iter().map(|&bytes| f32::from_le_bytes(bytes));
        Some(speeds.map(|speed| speed.is_finite().then(|| speed.into())).collect())
    }

    /// Commands of a network that reads them; of others used where they fit, ignored where not.
    fn commands(&mut self, needed: bool) -> Result<Option<Vec<u8>>> {
        let found = match needed {
            true => Some(self.tensor("command", Dtype::I32, &[])?),
            false => {
                let fits = |v: &TensorView<'_>| v.dtype() == Dtype::I32 && v.shape() == [self.frames.unwrap_or(0)];
                self.file.tensor("command").ok().filter(fits)
            }
        };
        let Some(view) = found else { return Ok(None) };
        let command = |bytes: &[u8; 4]| {
            let value = i32::from_le_bytes(*bytes);
            u8::try_from(value).ok().filter(|c| (1..=6).contains(c)).ok_or(value)
        };
        match view.data().as_chunks::<4>().0.iter().map(command).collect::<std::result::Result<_, _>>() {
            Ok(commands) => Ok(Some(commands)),
            Err(_) if !needed => Ok(None),
            Err(value) => Err(tensor_error("command", format!("holds {value}, expected 1..=6"))),
        }
    }
}

/// `[C][H][W]` to `[H][W][C]`.
fn channel_fastest<T: Copy>(planes: &[T], channels: usize) -> Vec<T> {
    let plane = planes.len() / channels;
    (0..plane).flat_map(|p| (0..channels).map(move |c| planes[c * plane + p])).collect()
}

fn grey_levels(name: &str, values: &[f32]) -> Result<Vec<u8>> {
    let level = |&value: &f32| {
        let is_level = value.fract() == 0.0 && (0.0..=255.0).contains(&value);
        is_level.then_some(value as u8).ok_or_else(|| {
            tensor_error(name, format!("holds {value}, expected whole numbers 0..=255"))
                .with_help("give raw pixels; mean, deviation and scale are part of the network")
        })
    };
    values.iter().map(level).collect()
}

fn tensor_error(name: &str, message: impl Into<String>) -> Error {
    Error::new(ErrorCode::Frames, format!("tensor `{name}`"), message)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::InputKind;

    fn format() -> FrameFormat {
        let inputs = [
            (InputKind::Image, Shape::map(2, 1, 3)),
            (InputKind::Bev, Shape::map(1, 2, 2)),
            (InputKind::Velocity, Shape::vector(1)),
            (InputKind::Goal, Shape::vector(2)),
        ];
        FrameFormat::new("transfuser", inputs)
    }

    struct Tensor(&'static str, Dtype, Vec<usize>, Vec<u8>);

    fn good() -> Vec<Tensor> {
        let floats = |values: &[f32]| values.iter().flat_map(|v| v.to_le_bytes()).collect();
        vec![
            Tensor("rgb", Dtype::U8, vec![2, 3, 2, 1], (0..12).collect()),
            Tensor("bev", Dtype::U8, vec![2, 2, 1, 2], vec![0, 1, 2, 3, 4, 5, 0, 0]),
            Tensor("velocity", Dtype::F32, vec![2], floats(&[1.5, 2.5])),
            Tensor("target", Dtype::F32, vec![2, 2], floats(&[1.0, -2.0, 3.0, -4.0])),
            Tensor("command", Dtype::I32, vec![2], [1_i32, 4].iter().flat_map(|v| v.to_le_bytes()).collect()),
        ]
    }

    fn load_tensors(tensors: &[Tensor]) -> Result<Vec<Frame>> {
        load_as(&format(), tensors)
    }

    fn load_as(format: &FrameFormat, tensors: &[Tensor]) -> Result<Vec<Frame>> {
        let views = tensors.iter().map(|t| (t.0, TensorView::new(t.1, t.2.clone(), &t.3).unwrap()));
        let bytes = safetensors::serialize(views, None).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("inputs.safetensors");
        std::fs::write(&path, bytes).unwrap();
        load(&path, format)
    }

    #[test]
    fn planes_become_channel_fastest_maps() {
        let frames = load_tensors(&good()).unwrap();
        assert_eq!(frames.len(), 2);
        assert_eq!(frames[1].name, "inputs#1");
        assert_eq!(frames[1].rgb.as_ref().unwrap().data, [6, 8, 10, 7, 9, 11]);
        assert_eq!(frames[0].bev.as_ref().unwrap().data, [0, 2, 1, 3]);
        assert_eq!((frames[1].velocity, frames[1].goal, frames[1].command), (Some(2.5), Some([3.0, -4.0]), Some(4)));
    }

    #[test]
    fn a_network_that_reads_commands_needs_them() {
        let format = FrameFormat::new("cilrs", [(InputKind::Command, Shape::vector(1))]);
        let commands = |dtype, values: &[i32]| {
            let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            [Tensor("command", dtype, vec![values.len()], bytes)]
        };
        let frames = load_as(&format, &commands(Dtype::I32, &[6, 1])).unwrap();
        assert_eq!(frames.iter().map(|frame| frame.command).collect::<Vec<_>>(), [Some(6), Some(1)]);
        let message = |tensors: &[Tensor]| load_as(&format, tensors).unwrap_err().to_string();
        assert!(message(&commands(Dtype::I32, &[1, 7])).contains("tensor `command`: holds 7, expected 1..=6"));
        assert!(message(&commands(Dtype::F32, &[1])).contains("tensor `command`: F32 [1], expected I32 [N]"));
        assert!(message(&good()[..1]).contains("tensor `command`: missing; this network needs it"));
        assert_eq!(load_tensors(&good()[..4]).unwrap()[0].command, None, "others do not");
    }

    #[test]
    fn a_speed_that_no_network_reads_is_kept_where_it_is_one() {
        let aim = FrameFormat { velocity: false, ..format() };
        let speeds = |change: fn(&mut Tensor)| {
            let mut tensors = good();
            change(&mut tensors[2]);
            let frames = load_as(&aim, &tensors).unwrap();
            assert!(frames.iter().all(|frame| frame.velocity.is_none()));
            frames.iter().map(|frame| frame.speed).collect::<Vec<_>>()
        };
        assert_eq!(speeds(|_| ()), [Some(1.5), Some(2.5)]);
        assert_eq!(speeds(|tensor| tensor.3[..4].copy_from_slice(&f32::NAN.to_le_bytes())), [None, Some(2.5)]);
        assert_eq!(speeds(|tensor| tensor.0 = "other"), [None; 2]);
        assert_eq!(speeds(|tensor| tensor.1 = Dtype::I32), [None; 2]);
        assert_eq!(speeds(|tensor| tensor.2 = vec![1, 2]), [None; 2]);
        assert_eq!(load_tensors(&good()).unwrap()[1].speed, Some(2.5));
    }

    #[test]
    fn wrong_tensors_are_named_with_found_and_expected() {
        type Damage = fn(&mut Vec<Tensor>);
        let cases: [(Damage, &str); 6] = [
            (|t| drop(t.remove(0)), "tensor `rgb`: missing; this network needs it\n  help: the file holds: "),
            (|t| t[1].2 = vec![2, 2, 2, 1], "tensor `bev`: U8 [2, 2, 2, 1], expected U8 [2, 2, 1, 2]"),
            (|t| t[2].1 = Dtype::I32, "tensor `velocity`: I32 [2], expected F32 [2]"),
            (|t| t[3].2 = vec![1, 4], "tensor `target`: F32 [1, 4], expected F32 [2, 2]"),
            (|t| t[1].3[0] = 6, "tensor `bev`: holds 6, expected counts 0..=5"),
            (|t| t[2].3 = f32::NAN.to_le_bytes().repeat(2), "tensor `velocity`: holds NaN, expected finite values"),
        ];
        for (damage, expected) in cases {
            let mut tensors = good();
            damage(&mut tensors);
            let message = load_tensors(&tensors).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn a_classifier_reads_its_own_name_or_rgb_and_labels() {
        let format = FrameFormat::new("classifier", [(InputKind::Image, Shape::map(1, 2, 1))])
            .with_output("data", Some(Shape::vector(10)));
        let labels = |values: [i64; 2]| Tensor("label", Dtype::I64, vec![2], values.map(i64::to_le_bytes).concat());
        let floats = |values: [f32; 4]| values.map(f32::to_le_bytes).concat();
        let image = |name, values| Tensor(name, Dtype::F32, vec![2, 1, 1, 2], floats(values));
        let frames = load_as(&format, &[image("data", [0.0, 255.0, 7.0, 8.0]), labels([9, 0])]).unwrap();
        assert_eq!(frames[1].rgb.as_ref().unwrap().data, [7, 8]);
        assert_eq!(frames[0].label, Some(Label { class: 9, name: String::new() }));
        let frames = load_as(&format, &[Tensor("rgb", Dtype::U8, vec![2, 1, 1, 2], vec![1, 2, 3, 4])]).unwrap();
        assert_eq!((frames[1].rgb.as_ref().unwrap().data.as_slice(), &frames[1].label), (&[3, 4][..], &None));
        for (tensors, expected) in [
            (vec![image("data", [0.5, 0.0, 0.0, 0.0])], "tensor `data`: holds 0.5, expected whole numbers 0..=255"),
            (vec![image("data", [0.0, 0.0, 256.0, 0.0])], "tensor `data`: holds 256, expected whole numbers 0..=255"),
            (vec![image("data", [1.0; 4]), labels([0, -1])], "holds -1 for frame 1, the network has classes 0..=9"),
            (vec![image("other", [1.0; 4])], "tensor `data`: missing"),
        ] {
            let message = load_as(&format, &tensors).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn cells_are_pairs_of_row_and_column_inside_the_map() {
        let shape = Shape::map(1, 2, 4);
        let inputs = [(InputKind::BevPoints, shape), (InputKind::CameraPoints, shape)];
        let format = FrameFormat::new("geometric_fusion", inputs);
        let cells = |name, values: [i32; 16]| {
            Tensor(name, Dtype::I32, vec![2, 1, 2, 2, 2], values.map(i32::to_le_bytes).concat())
        };
        let good = [0, 1, 0, 0, 0, 1, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0];
        let frames = load_as(&format, &[cells("bev_points", good), cells("cam_points", [0; 16])]).unwrap();
        assert_eq!(frames[0].bev_points.as_ref().unwrap().data, [0, 1, 0, 0, 0, 1, 0, 1]);
        assert_eq!(frames[1].bev_points.as_ref().unwrap().data, [0, 0, 0, 0, 0, 1, 0, 0]);
        assert_eq!(frames[1].raw(InputKind::CameraPoints).unwrap(), [0.0; 8]);
        for (at, value, expected) in
            [(3, 2, "holds 2, expected cells 0..=1"), (2, -1, "holds -1, expected cells 0..=0")]
        {
            let mut bad = good;
            bad[at] = value;
            let message =
                load_as(&format, &[cells("bev_points", bad), cells("cam_points", good)]).unwrap_err().to_string();
            assert!(message.contains(&format!("tensor `bev_points`: {expected}")), "{message}");
        }
        let message = load_as(&format, &[cells("bev_points", good)]).unwrap_err().to_string();
        assert!(message.contains("tensor `cam_points`: missing"), "{message}");
    }

    #[test]
    fn a_file_that_is_no_safetensors_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.safetensors");
        std::fs::write(&path, b"not at all").unwrap();
        assert!(load(&path, &format()).unwrap_err().to_string().contains("not a safetensors file"));
    }

    /// The histogram rule against the networks' own preprocessing, cell by cell.
    ///
    /// The file labels its counts `[2, 256, 256]`, but their bytes lie channel-fastest, as the histogram is made (the
    /// other reading puts points of a street scene into every second column only).
    #[test]
    fn golden_points_give_the_golden_histogram() {
        let workspace_neighbor = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared");
        let shared = std::env::var_os("SHARED_DIR").map_or_else(workspace_neighbor, std::path::PathBuf::from);
        let Ok(bytes) = std::fs::read(shared.join("golden/bev.safetensors")) else {
            println!("not run: shared/golden/bev.safetensors is absent");
            return;
        };
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let (points, counts) = (file.tensor("points").unwrap(), file.tensor("bev_counts").unwrap());
        let coordinate = |b: &[u8], i: usize| f64::from(f32::from_le_bytes([0, 1, 2, 3].map(|k| b[4 * i + k])));
        let points = points.data().chunks_exact(12).map(|b| [0, 1, 2].map(|i| coordinate(b, i)));
        let (map, dropped) = bev::histogram(points, -2.0, bev::SHAPE);
        assert_eq!(dropped, 0);
        assert_eq!(counts.data().iter().map(|&c| u32::from(c)).sum::<u32>(), 9422);
        for (i, (&found, &expected)) in map.data.iter().zip(counts.data()).enumerate() {
            assert_eq!(found, expected, "row {}, column {}, channel {}", i / 512, i / 2 % 256, i % 2);
        }
        assert_eq!(map.data.len(), counts.data().len());
    }
}
