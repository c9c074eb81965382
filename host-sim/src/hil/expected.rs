//! What a board must answer: the host's own run of the same image over the same frame.

use crate::answer::{self, Answer};
use crate::backends::Backend;
use crate::codes::decode;
use crate::run::Device;
use crate::{points::PixelGrid, system};
use firmware::drive::{Controls, Fault, Output, Profile, Real, Status};
use firmware::image::{Image, crc32};
use firmware::link::End;
use firmware::tensor::ElementType;
use model_compiler::error::Result;
use model_compiler::frames::Frame;

/// What the network of one frame must give.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Expected {
    /// Bytes of every output.
    pub outputs: Vec<Vec<u8>>,
    /// CRC-32 of the bytes that each step writes.
    pub step_crcs: Vec<u32>,
}

/// The image on the host.
pub struct Host<'a> {
    image: Image<'a>,
    device: Device<'a>,
    /// Of a driving network.
    profile: Option<Profile>,
}

impl<'a> Host<'a> {
    /// An image on these kernels.
    ///
    /// # Errors
    /// It has no output.
    pub fn new(image: Image<'a>, backend: Backend) -> Result<Self> {
        let maps = image.output(answer::output_of(&image)).and_then(|port| PixelGrid::of_image(&image, port.tensor));
        let system = system::of_inputs(&system::input_names(&image));
        let profile = system.map(|system| system::profile(system, maps));
        Ok(Self { image, device: Device::new(image, backend)?, profile })
    }

    /// The network's inputs as the host prepares them.
    ///
    /// # Errors
    /// The frame lacks one.
    pub fn inputs(&self, frame: &Frame) -> Result<Vec<Vec<u8>>> {
        self.device.input_bytes(frame)
    }

    /// Runs the network.
    ///
    /// # Errors
    /// The frame lacks an input, or the engine refuses.
    pub fn run(&mut self, frame: &Frame) -> Result<Expected> {
        let image = self.image;
        let outputs = (0..image.output_count()).filter_map(|output| image.output(output));
        let outputs: Vec<_> = outputs.map(|port| port.tensor).collect();
        let mut expected = Expected { outputs: vec![Vec::new(); outputs.len()], step_crcs: Vec::new() };
        self.device.infer_observed(frame, |_, step, written| {
            expected.step_crcs.push(crc32(written));
            for (bytes, _) in expected.outputs.iter_mut().zip(&outputs).filter(|(_, id)| **id == step.output()) {
                *bytes = written.to_vec();
            }
        })?;
        Ok(expected)
    }

    /// What these bytes of the outputs tell a driver; `None` where the network is no driving one.
    pub fn answer(&self, outputs: &[Vec<u8>]) -> Option<Answer> {
        let index = answer::output_of(&self.image);
        let bytes = outputs.get(usize::from(index))?;
        Answer::of_codes(&self.profile.as_ref()?.answer, &decode(bytes, self.element(index)?))
    }

    /// What the actuators are told of a frame that is not part of a drive: by a controller in its fresh state.
    pub fn output(&self, end: &End, answer: Option<&Answer>) -> Output {
        let stopped = |fault| Output { controls: Controls::stop(Real::ZERO), status: Status::Fault(fault) };
        match (end, &self.profile) {
            (End::Infer(Some(inputs)), Some(profile)) => {
                let output =
                    answer.ok_or(Fault::NetworkFailed).and_then(|a| a.output().map_err(|_| Fault::NetworkFailed));
                let controls = output.and_then(|output| profile.controls(output, Real::from(inputs.velocity)));
                controls.map_or_else(stopped, |controls| Output { controls, status: Status::Driving })
            }
            _ => Output { controls: Controls::ZERO, status: Status::Filling },
        }
    }

    /// The class that a classifier's first output names: of equal codes the first.
    pub fn class(&self, outputs: &[Vec<u8>]) -> Option<usize> {
        let codes = decode(outputs.first()?, self.element(0)?);
        let largest = codes.iter().max()?;
        codes.iter().position(|code| code == largest)
    }

    fn element(&self, output: u8) -> Option<ElementType> {
        let port = self.image.output(output)?;
        self.image.tensor(port.tensor).map(|record| record.element)
    }
}
