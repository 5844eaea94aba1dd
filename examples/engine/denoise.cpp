// Denoise frames by a graph of `mcdenoise export`: denoise MODEL WIDTH HEIGHT <frames >images
// A frame is its buffers in the graph's order, an image has three channels: each channel as float32, row by row.
#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <iostream>
#include <string>
#include <vector>

using namespace std::string_literals;

int main(int, char** given) {
    const int64_t width = std::stoll(given[2]), height = std::stoll(given[3]);
    Ort::Env env;
    Ort::Session session(env, given[1], Ort::SessionOptions{});
    Ort::AllocatorWithDefaultOptions memory;
    const auto bytes = [](const Ort::Value& value) { return 4 * value.GetTensorTypeAndShapeInfo().GetElementCount(); };
    std::vector<const char*> inputs, outputs;
    std::vector<Ort::Value> values;  // of the inputs; before the first frame, the state is zeros
    for (size_t i = 0; i < session.GetInputCount(); ++i) {
        inputs.push_back(session.GetInputNameAllocated(i, memory).release());
        const Ort::TypeInfo type = session.GetInputTypeInfo(i);
        const auto tensor = type.GetTensorTypeAndShapeInfo();
        std::vector<int64_t> shape = tensor.GetShape();
        std::vector<const char*> axes(shape.size());
        tensor.GetSymbolicDimensions(axes.data(), axes.size());
        for (size_t k = 0; k < shape.size(); ++k)  // -1 is a free size, whose axis has a name
            if (shape[k] < 0) shape[k] = axes[k] == "height"s ? height : axes[k] == "width"s ? width : 1;
        values.push_back(Ort::Value::CreateTensor<float>(memory, shape.data(), shape.size()));
        std::fill_n(values[i].GetTensorMutableData<char>(), bytes(values[i]), 0);
    }
    for (size_t i = 0; i < session.GetOutputCount(); ++i)
        outputs.push_back(session.GetOutputNameAllocated(i, memory).release());
    while (true) {
        for (size_t i = 0; i < values.size(); ++i)
            if (std::string(inputs[i]).rfind("state.", 0) != 0)
                std::cin.read(values[i].GetTensorMutableData<char>(), bytes(values[i]));
        if (!std::cin) return 0;
        auto results = session.Run({}, inputs.data(), values.data(), inputs.size(), outputs.data(), outputs.size());
        std::cout.write(results[0].GetTensorData<char>(), bytes(results[0]));
        for (size_t i = 0; i < values.size(); ++i)  // the state after a frame is that before the next one
            for (size_t k = 1; k < results.size(); ++k)
                if (outputs[k] == "next_" + std::string(inputs[i])) values[i] = std::move(results[k]);
    }
}
