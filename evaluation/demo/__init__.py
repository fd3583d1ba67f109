"""One run in real time: simulation, robot and vision as processes, then scored and filmed."""
