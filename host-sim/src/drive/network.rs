//! The two networks of a drive: the engine's integers, and the f32 network on the same inputs.

use super::sensors::Rig;
use crate::answer::{self, Answer, CONTROLS};
use crate::backends::Backend;
use crate::buffers::GuardedArena;
use crate::codes::decode;
use firmware::drive::profile::Answer as AnswerKind;
use firmware::engine::{Engine, EngineError};
use firmware::image::{Image, Port};
use firmware::tensor::ElementType;
use model_compiler::error::{Error, ErrorCode, Result};
use model_compiler::ir::Graph;
use model_compiler::reference;

/// An image on the engine.
pub struct IntegerNetwork<'a> {
    image: Image<'a>,
    backend: Backend,
    arena: GuardedArena,
    kind: AnswerKind,
    output: u8,
    element: ElementType,
}

impl<'a> IntegerNetwork<'a> {
    /// A network that answers so.
    ///
    /// # Errors
    /// It has no output.
    pub fn new(image: Image<'a>, backend: Backend, kind: AnswerKind) -> Result<Self> {
        let output = answer::output_of(&image);
        let record = image.output(output).and_then(|port| image.tensor(port.tensor));
        let element = record.map(|record| record.element).ok_or_else(|| {
            Error::new(ErrorCode::Unsupported, format!("network {}", image.name()), "it has no output")
        })?;
        let arena = GuardedArena::new(&image);
        Ok(Self { image, backend, arena, kind, output, element })
    }

    /// One inference.
    ///
    /// # Errors
    /// The engine refuses, or the output is none of a driving network.
    pub fn infer(&mut self, inputs: &[Vec<u8>]) -> Result<Answer> {
        let inputs: Vec<&[u8]> = inputs.iter().map(Vec::as_slice).collect();
        let refuse = |e: EngineError| Error::new(ErrorCode::Malformed, "engine", e.to_string());
        let mut engine = Engine::new(self.image, self.backend.kernels(), self.arena.poisoned(0)).map_err(refuse)?;
        engine.infer(&inputs).map_err(refuse)?;
        let codes = decode(engine.output(self.output.into()).map_err(refuse)?, self.element);
        Answer::of_codes(&self.kind, &codes).ok_or_else(|| unreadable(self.image.name()))
    }
}

/// A graph in f32.
pub struct FloatNetwork {
    graph: Graph,
    kind: AnswerKind,
    output: usize,
}

impl FloatNetwork {
    /// A graph with the inputs of the image.
    ///
    /// # Errors
    /// The graph reads an input that the image does not have, or one of another size.
    pub fn new(graph: Graph, kind: AnswerKind, rig: &Rig<'_>) -> Result<Self> {
        let refuse = |message: String, help: &str| {
            Err(Error::new(ErrorCode::Usage, format!("network {}", graph.name), message).with_help(help))
        };
        let inputs = || graph.inputs().map(|(id, input)| (input.name(), graph.value(id).shape));
        if let Some((name, _)) = inputs().find(|(name, _)| rig.shape(name).is_none()) {
            let help = "--model takes the checkpoint that the image was compiled from";
            return refuse(format!("it reads `{name}`, which the image does not"), help);
        }
        for (name, expected) in inputs() {
            let Some(found) = rig.shape(name).filter(|found| found.elements() != expected.elements()) else { continue };
            let [expected, found] = [expected, found].map(|s| format!("{}×{}×{}", s.height, s.width, s.channels));
            let help = "--resolution HxW gives the size that the image was compiled for";
            return refuse(format!("its input `{name}` is {expected}, the image's {found}"), help);
        }
        let output = graph.outputs.iter().position(|&id| graph.value(id).name == CONTROLS).unwrap_or(0);
        Ok(Self { graph, kind, output })
    }

    /// One inference on the real values of the image's inputs.
    ///
    /// # Errors
    /// The graph cannot be run, or its output is none of a driving network.
    pub fn infer(&self, rig: &Rig<'_>, inputs: &[Vec<u8>], image: &Image<'_>) -> Result<Answer> {
        let raw = |name: &str| {
            let found = rig.ports().zip(inputs).find(|(port, _)| port.name == name);
            found.map_or_else(Vec::new, |(port, bytes)| real(port, bytes, image))
        };
        let inputs: Vec<Vec<f32>> = self.graph.inputs().map(|(_, kind)| raw(kind.name())).collect();
        let outputs = reference::run(&self.graph, &inputs, |_, _| ())?;
        let values = outputs.get(self.output).map_or(&[][..], Vec::as_slice);
        Answer::of_real(&self.kind, values).ok_or_else(|| unreadable(&self.graph.name))
    }
}

fn unreadable(network: &str) -> Error {
    Error::new(ErrorCode::Unsupported, format!("network {network}"), "its output is none of a driving network")
}

/// Raw values of an input's codes. Of a histogram they are counts, as the frames of calibration hold them.
fn real(port: &Port<'_>, bytes: &[u8], image: &Image<'_>) -> Vec<f32> {
    let element = image.tensor(port.tensor).map_or(ElementType::I8, |record| record.element);
    let scale = if port.name == "bev" { 1.0 } else { f64::from(port.scale) };
    let real = |code: i32| (scale * (f64::from(code) - f64::from(port.zero_point))) as f32;
    decode(bytes, element).into_iter().map(real).collect()
}
