"""Runs ONNX models with ONNX Runtime, as they are (no optimizations), each on one image.

Standard input: a JSON list of {"model", "input", "shape", "output"}. `input` holds float32 values of `shape`; all
outputs of the model, one after the other, go to `output` as float32.
"""

import json
import sys

import numpy
import onnxruntime

options = onnxruntime.SessionOptions()
options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
options.intra_op_num_threads = 1
for case in json.load(sys.stdin):
    try:
        session = onnxruntime.InferenceSession(case["model"], options, providers=["CPUExecutionProvider"])
        image = numpy.fromfile(case["input"], dtype="<f4").reshape(case["shape"])
        outputs = session.run(None, {session.get_inputs()[0].name: image})
    except Exception as error:
        sys.exit(f"{case['model']}: {error}")
    numpy.concatenate([output.astype("<f4").ravel() for output in outputs]).tofile(case["output"])
