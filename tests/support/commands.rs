//! The two programs as a user runs them, in a folder of their own.

use crate::build;
use crate::golden::{self, Network};
use crate::torch_file::{Py, Saved};
use model_compiler::cli::Console;
use model_compiler::frames::views::LEVELS;
use model_compiler::frames::{ByteMap, Frame, RealMap};
use model_compiler::import::{NamedTensors, TensorData};
use safetensors::Dtype;
use safetensors::tensor::TensorView;
use serde_json::Value;
use std::ffi::OsString;
use std::path::PathBuf;
use tempfile::TempDir;

/// A folder for the files of a test; `@name` in commands and texts is a file in it.
#[derive(Debug)]
pub struct Folder(TempDir);

/// What a command left behind.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// Exit status.
    pub status: u8,
    /// Standard output.
    pub out: String,
    /// Standard error.
    pub err: String,
}

impl Default for Folder {
    fn default() -> Self {
        Self(tempfile::tempdir().expect("a temporary folder"))
    }
}

impl Folder {
    /// A folder with `net.safetensors` (checkpoint) and `inputs.safetensors` (the stored frames, cropped).
    ///
    /// # Panics
    /// It cannot be written.
    pub fn of(network: &Network) -> Self {
        let folder = Self::default();
        let tensors = network.tensors();
        golden::write_safetensors(&tensors, &folder.path("net.safetensors")).expect("a writable folder");
        folder.write("inputs.safetensors", inputs_file(&build::frames_of(&build::graph(tensors))));
        folder
    }

    /// Path of a file.
    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Writes a file, and the folders above it.
    ///
    /// # Panics
    /// It cannot be written.
    pub fn write(&self, name: &str, bytes: impl AsRef<[u8]>) {
        let path = self.path(name);
        std::fs::create_dir_all(path.parent().expect("a file in the folder")).expect("a writable folder");
        std::fs::write(path, bytes).expect("a writable folder");
    }

    /// Bytes of a file.
    ///
    /// # Panics
    /// It cannot be read.
    pub fn read(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.path(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
    }

    /// Names in the folder, sorted.
    ///
    /// # Panics
    /// It cannot be read.
    pub fn names(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.0.path()).expect("a readable folder");
        let mut names: Vec<_> =
            entries.map(|e| e.expect("an entry").file_name().into_string().expect("text")).collect();
        names.sort();
        names
    }

    /// Runs `model-compiler …` or `host-sim …`; words are divided by spaces.
    ///
    /// # Panics
    /// It is another program, or it writes something that is no text.
    pub fn run(&self, command: &str) -> Outcome {
        let word = |word: &str| word.strip_prefix('@').map_or(word.into(), |name| self.path(name).into());
        let words: Vec<OsString> = command.split(' ').map(word).collect();
        let (mut out, mut err) = (Vec::new(), Vec::new());
        let console = Console { out: &mut out, err: &mut err };
        let status = match words[0].to_str() {
            Some("model-compiler") => model_compiler::cli::main(words, console),
            Some("host-sim") => host_sim::cli::main(words, console),
            _ => panic!("no program of this workspace: {command}"),
        };
        let text = |bytes| self.shown(&String::from_utf8(bytes).expect("text"));
        Outcome { status, out: text(out), err: text(err) }
    }

    /// Standard output of a command that must succeed without a word on standard error.
    ///
    /// # Panics
    /// It does not.
    pub fn ok(&self, command: &str) -> String {
        let outcome = self.run(command);
        assert_eq!((outcome.status, outcome.err.as_str()), (0, ""), "{command}");
        outcome.out
    }

    /// Exit status and JSON document of a command.
    ///
    /// # Panics
    /// The output is no JSON.
    pub fn json(&self, command: &str) -> (u8, Value) {
        let outcome = self.run(command);
        let document = serde_json::from_str(&outcome.out);
        (outcome.status, document.unwrap_or_else(|e| panic!("{command}: {e}: {}{}", outcome.out, outcome.err)))
    }

    /// A text with `@` for the folder.
    pub fn shown(&self, text: &str) -> String {
        text.replace(&format!("{}/", self.0.path().display()), "@")
    }
}

/// A file of the data that lies beside the repository, if it is there.
pub fn shared(name: &str) -> Option<PathBuf> {
    let beside = || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared");
    let path = std::env::var_os("SHARED_DIR").map_or_else(beside, PathBuf::from).join(name);
    if !path.exists() {
        println!("not run: {name} is not in the shared data");
        return None;
    }
    Some(path)
}

/// A checkpoint as torch saves it.
pub fn torch(tensors: &NamedTensors) -> Saved {
    let stored: Vec<_> = tensors
        .iter()
        .map(|(name, tensor)| match &tensor.data {
            TensorData::Float(values) => {
                let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
                (name, "FloatStorage", tensor.shape.as_slice(), bytes)
            }
            TensorData::Integer => {
                let bytes = 1i64.to_le_bytes().repeat(tensor.shape.iter().product());
                (name, "LongStorage", tensor.shape.as_slice(), bytes)
            }
        })
        .collect();
    Saved::of_types(&stored)
}

/// A checkpoint as PyTorch Lightning saves it: the weights among hyper-parameters and what training left.
pub fn lightning(saved: Saved) -> Vec<u8> {
    let path = Py::Call("pathlib", "PosixPath", vec![Py::str("/"), Py::str("data")]);
    let wrapped = saved.wrap(|weights| {
        Py::dict([
            ("epoch", Py::Int(29)),
            ("optimizer_states", Py::List(vec![Py::dict([("lr", Py::Float(2e-4))])])),
            ("state_dict", weights),
            ("hparams_name", Py::str("hparams")),
            ("hyper_parameters", Py::dict([("hack", Py::Bool(true)), ("dataset_dir", path)])),
        ])
    });
    wrapped.zip()
}

/// Frames as a `.safetensors` file of raw network inputs.
///
/// # Panics
/// A frame lacks something.
pub fn inputs_file(frames: &[Frame]) -> Vec<u8> {
    let planes = |map: &ByteMap| -> Vec<u8> {
        let channels = usize::from(map.shape.channels);
        (0..channels).flat_map(|c| map.data.iter().skip(c).step_by(channels).copied()).collect()
    };
    let maps = |map: fn(&Frame) -> &Option<ByteMap>| -> (Vec<usize>, Vec<u8>) {
        let shape = map(&frames[0]).as_ref().expect("a map").shape;
        let shape = vec![frames.len(), shape.channels.into(), shape.height.into(), shape.width.into()];
        (shape, frames.iter().flat_map(|frame| planes(map(frame).as_ref().expect("a map"))).collect())
    };
    let floats = |values: fn(&Frame) -> Vec<f64>| -> Vec<u8> {
        frames.iter().flat_map(values).flat_map(|v| (v as f32).to_le_bytes()).collect()
    };
    let cells = |map: fn(&Frame) -> &Option<ByteMap>| -> Option<(Vec<usize>, Vec<u8>)> {
        let shape = map(&frames[0]).as_ref()?.shape;
        let shape = [frames.len(), shape.height.into(), shape.width.into(), usize::from(shape.channels) / 2, 2];
        let numbers = frames.iter().flat_map(|frame| &map(frame).as_ref().expect("lists of cells").data);
        Some((shape.to_vec(), numbers.flat_map(|&cell| i32::from(cell).to_le_bytes()).collect()))
    };
    let commands = frames.iter().flat_map(|f| i32::from(f.command.expect("a command")).to_le_bytes()).collect();
    let (rgb, bev) = (maps(|f| &f.rgb), maps(|f| &f.bev));
    let mut tensors = vec![
        ("rgb", Dtype::U8, rgb.0, rgb.1),
        ("bev", Dtype::U8, bev.0, bev.1),
        ("velocity", Dtype::F32, vec![frames.len()], floats(|f| vec![f.velocity.expect("a speed")])),
        ("target", Dtype::F32, vec![frames.len(), 2], floats(|f| f.goal.expect("a goal").to_vec())),
        ("command", Dtype::I32, vec![frames.len()], commands),
    ];
    let lists = [("bev_points", cells(|f| &f.bev_points)), ("cam_points", cells(|f| &f.camera_points))];
    tensors.extend(
        lists.into_iter().filter_map(|(name, lists)| lists.map(|(shape, data)| (name, Dtype::I32, shape, data))),
    );
    let views = tensors.iter().map(|(name, element, shape, data)| {
        (*name, TensorView::new(*element, shape.clone(), data).expect("shape and data agree"))
    });
    safetensors::serialize(views, None).expect("names differ")
}

/// Frames of LBC as a `.safetensors` file of its raw input, 0..=1.
///
/// # Panics
/// A frame lacks views.
pub fn views_file(frames: &[Frame]) -> Vec<u8> {
    let views = |frame: &Frame| frame.views.clone().expect("views");
    let shape = views(&frames[0]).shape;
    let planes = |frame: &Frame| {
        let RealMap { data, shape } = views(frame);
        let channels = usize::from(shape.channels);
        let plane = |c: usize| data.iter().skip(c).step_by(channels).map(|v| v / LEVELS).collect::<Vec<_>>();
        (0..channels).flat_map(plane).flat_map(f32::to_le_bytes).collect::<Vec<u8>>()
    };
    let data: Vec<u8> = frames.iter().flat_map(planes).collect();
    let shape = vec![frames.len(), shape.channels.into(), shape.height.into(), shape.width.into()];
    let view = TensorView::new(Dtype::F32, shape, &data).expect("shape and data agree");
    safetensors::serialize([("lbc_input", view)], None).expect("one name")
}

/// A frame of a frame directory: `rgb.png`, `lidar.bin` with a few walls of points, `frame.json`.
///
/// # Panics
/// It cannot be written.
pub fn write_frame(folder: &Folder, name: &str, frame: &Frame) {
    let rgb = frame.rgb.as_ref().expect("an image");
    folder.write(&format!("{name}/frame.json"), b"");
    let (width, height) = (rgb.shape.width.into(), rgb.shape.height.into());
    let path = folder.path(&format!("{name}/rgb.png"));
    image::save_buffer(path, &rgb.data, width, height, image::ColorType::Rgb8).expect("a writable folder");
    let wall = |i: u16| [f32::from(i % 40) - 20.0, f32::from(i / 40) + 5.0, f32::from(i % 3) - 2.5, 0.5];
    let lidar: Vec<u8> = (0..800).flat_map(wall).flat_map(f32::to_le_bytes).collect();
    folder.write(&format!("{name}/lidar.bin"), lidar);
    let [right, y] = frame.goal.expect("a goal");
    let description = serde_json::json!({
        "speed": frame.velocity, "goal": [right, -y], "command": 4, "lidar_axes": "carla", "lidar_height_m": 2.5,
    });
    folder.write(&format!("{name}/frame.json"), description.to_string());
}
